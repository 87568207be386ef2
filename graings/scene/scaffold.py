"""Scaffold: the anchors and their learnable attributes (Eq. 3)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn


class Scaffold(nn.Module):
    """A anchors with k child slots each.

    `anchors` [A, 3] and `uids` [A] are buffers: anchors stay on the voxel grid on which they were created, and the
    child offsets adapt the positions. After `learn_anchors`, `anchors` is a parameter. Parameters: `log_scales` [A, 3]
    (log s_a, normalised units), `features` [A, d_f], `offsets` [A, k, 3] (epsilon of Eq. 4, in units of s_a),
    `opacity_offsets` [A] or [A, k] (added inside the tanh of Eq. 11, so that a new anchor can start with low opacity
    although it inherits its parent's features). Raises `ValueError` where these have another shape.
    """

    ROWS = ("anchors", "uids", "log_scales", "features", "offsets", "opacity_offsets")  # tensors with a row per anchor

    anchors: Tensor
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
        self.register_buffer("anchors", anchors)
        self.register_buffer("uids", torch.arange(count) if uids is None else uids)
        self.log_scales = nn.Parameter(log_scales)
        self.features = nn.Parameter(features)
        self.offsets = nn.Parameter(offsets)
        opacity_offsets = anchors.new_zeros(count) if opacity_offsets is None else opacity_offsets
        if tuple(opacity_offsets.shape) not in {(count,), tuple(offsets.shape[:2])}:
            raise ValueError(
                f"opacity_offsets must have a row for each anchor, not shape {tuple(opacity_offsets.shape)}"
            )
        self.opacity_offsets = nn.Parameter(opacity_offsets)

    def learn_anchors(self) -> None:
        """Make the anchor positions a parameter, as in Eq. 3."""
        positions = self.anchors.detach()
        del self.anchors
        self.anchors = nn.Parameter(positions)

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
