"""Scaffold: the anchors and their learnable attributes (Eq. 3)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn


class Scaffold(nn.Module):
    """A anchors with k child slots each.

    Parameters: `anchors` [A, 3] (x_a, normalised units), `log_scales` [A, 3] (log s_a), `features` [A, d_f], `offsets`
    [A, k, 3] (epsilon of Eq. 4, in units of s_a), `opacity_offsets` [A] or [A, k] (added inside the tanh of Eq. 11, so
    that a new anchor can start with low opacity although it inherits its parent's features). `uids` [A] is a buffer.
    Raises `ValueError` where these have another shape.
    """

    ROWS = ("anchors", "uids", "log_scales", "features", "offsets", "opacity_offsets")  # tensors with a row per anchor

    uids: Tensor

    def __init__(
        self,
        anchors: Float[Tensor, "anchor 3"],
        log_scales: Float[Tensor, "anchor 3"],
        features: Float[Tensor, "anchor feature"],
        offsets: Float[Tensor, "anchor child 3"],
        opacity_offsets: Tensor | None = None,
        uids: Int64[Tensor, " anchor"] | None = None,
    ) -> None:
        super().__init__()
        count = anchors.shape[0]
        opacity_offsets = anchors.new_zeros(count) if opacity_offsets is None else opacity_offsets
        uids = torch.arange(count) if uids is None else uids
        slots = offsets.shape[1] if offsets.dim() == 3 else 0
        for name, tensor, shapes in (
            ("anchors", anchors, [(count, 3)]),
            ("log_scales", log_scales, [(count, 3)]),
            ("features", features, [(count, features.shape[-1])]),
            ("offsets", offsets, [(count, slots, 3)]),
            ("opacity_offsets", opacity_offsets, [(count,), (count, slots)]),
            ("uids", uids, [(count,)]),
        ):
            if tuple(tensor.shape) not in shapes:
                raise ValueError(f"{name} must have shape {' or '.join(map(str, shapes))}, got {tuple(tensor.shape)}")
        self.register_buffer("uids", uids)
        self.anchors = nn.Parameter(anchors)
        self.log_scales = nn.Parameter(log_scales)
        self.features = nn.Parameter(features)
        self.offsets = nn.Parameter(offsets)
        self.opacity_offsets = nn.Parameter(opacity_offsets)

    @property
    def slot_opacity_offsets(self) -> Float[Tensor, "anchor own"]:
        """`opacity_offsets` as [A, 1] or [A, k]."""
        return per_slot(self.opacity_offsets)

    @property
    def count(self) -> int:
        """Number of anchors A."""
        return int(self.anchors.shape[0])

    @property
    def slots(self) -> int:
        """Child slots per anchor k."""
        return int(self.offsets.shape[1])

    def child_uids(self, children: Int64[Tensor, " gaussian"]) -> Int64[Tensor, " gaussian"]:
        """Identifiers of the given flat child slots that stay the same when anchors are added, removed or reordered."""
        owners = children // self.slots
        return self.uids.index_select(0, owners) * self.slots + children % self.slots


def per_slot(opacity_offsets: Float[Tensor, " anchor"] | Float[Tensor, "anchor child"]) -> Float[Tensor, "anchor own"]:
    """Opacity offsets of anchors or of their slots as [A, 1] or [A, k], to be added to [A, k]."""
    return opacity_offsets if opacity_offsets.dim() == 2 else opacity_offsets.unsqueeze(-1)
