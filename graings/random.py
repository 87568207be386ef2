"""Seeds by name, so that leaving one part out does not change the numbers of another.

Knows nothing of what the numbers are used for.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


def stream_seed(seed: int, name: str) -> int:
    """The seed of the part `name` in a run of `seed`; 63 bits."""
    digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


@contextmanager
def torch_stream(seed: int, name: str) -> Iterator[None]:
    """Torch's global stream, from which modules draw their weights, is that of `name` inside and as before after."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(stream_seed(seed, name))
        yield


class RandomStreams:
    """Generators by name, created on first use and saved whole."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._generators: dict[str, torch.Generator] = {}

    def __getitem__(self, name: str) -> torch.Generator:
        if name not in self._generators:
            generator = torch.Generator()
            generator.manual_seed(stream_seed(self.seed, name))
            self._generators[name] = generator
        return self._generators[name]

    def state(self) -> dict[str, Tensor]:
        """State of every stream used so far."""
        return {name: generator.get_state() for name, generator in sorted(self._generators.items())}

    def load(self, state: dict[str, Tensor]) -> None:
        """Continue where `state` was taken."""
        for name, tensor in state.items():
            self[name].set_state(tensor)
