"""Scaffold: the anchors and what each of them carries (Eq. 3).

Knows nothing of networks, cameras, time or pixels.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn


class Scaffold(nn.Module):
    """A anchors with k child slots each.

    `anchors` [A, 3] and `uids` [A] are buffers: anchors sit on their voxel grid for good (decision 12), the
    child offsets do the moving. Parameters: `log_scales` [A, 3] (log s_a, normalised units), `features`
    [A, d_f], `offsets` [A, k, 3] (in units of s_a), `opacity_offsets` [A] (added inside the tanh of Eq. 11,
    decision 4: the way an anchor can be born faint).
    """

    ROWS = ("anchors", "uids", "log_scales", "features", "offsets", "opacity_offsets")

    anchors: Tensor
    uids: Tensor

    def __init__(
        self,
        anchors: Float[Tensor, "anchor 3"],
        log_scales: Float[Tensor, "anchor 3"],
        features: Float[Tensor, "anchor feature"],
        offsets: Float[Tensor, "anchor child 3"],
        opacity_offsets: Float[Tensor, " anchor"] | None = None,
        uids: Int64[Tensor, " anchor"] | None = None,
    ) -> None:
        super().__init__()
        count = anchors.shape[0]
        self.register_buffer("anchors", anchors)
        self.register_buffer("uids", torch.arange(count) if uids is None else uids)
        self.log_scales = nn.Parameter(log_scales)
        self.features = nn.Parameter(features)
        self.offsets = nn.Parameter(offsets)
        self.opacity_offsets = nn.Parameter(anchors.new_zeros(count) if opacity_offsets is None else opacity_offsets)

    @property
    def count(self) -> int:
        """Number of anchors A."""
        return int(self.anchors.shape[0])

    @property
    def slots(self) -> int:
        """Child slots per anchor k."""
        return int(self.offsets.shape[1])

    def child_uids(self, children: Int64[Tensor, " drawn"]) -> Int64[Tensor, " drawn"]:
        """Persistent birth numbers of the given flat child slots."""
        owners = children // self.slots
        return self.uids.index_select(0, owners) * self.slots + children % self.slots
