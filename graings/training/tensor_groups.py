"""Groups of named tensors as one flat dictionary, `group/name`, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor


def joined(groups: Mapping[str, Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """All tensors under `group/name`."""
    return {f"{group}/{name}": tensor for group, members in groups.items() for name, tensor in members.items()}


def split(tensors: Mapping[str, Tensor], groups: Sequence[str]) -> dict[str, dict[str, Tensor]]:
    """The inverse of `joined`; every one of `groups` is there, if empty. Raises `KeyError` for another group."""
    parts: dict[str, dict[str, Tensor]] = {group: {} for group in groups}
    for key, tensor in tensors.items():
        group, _, name = key.partition("/")
        parts[group][name] = tensor
    return parts
