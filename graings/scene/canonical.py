"""Canonical geometry of the children: rotation and log-scale from StaticMLP (Eq. 5).

Knows nothing of time, viewing direction or pixels.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from graings.config import SceneConfig
from graings.scene.perceptron import perceptron

# A child starts with about half the spacing of its neighbours as standard deviation: they overlap, but
# none hides the next (decision 12).
INITIAL_SCALE = 0.5


def one_hot(slots: Int64[Tensor, " drawn"], codes: Float[Tensor, "child width"]) -> Float[Tensor, "drawn child"]:
    """A one in the column of each child's slot: what picks its code in a first layer."""
    return torch.eye(len(codes), dtype=codes.dtype, device=codes.device).index_select(0, slots)


def identity_quaternion(like: Tensor) -> Tensor:
    """(1, 0, 0, 0) in the dtype of `like`."""
    return torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=like.dtype, device=like.device)


class StaticMLP(nn.Module):
    """(f_a, eps_j, e_j) -> (r_can, rho_can) for each child by itself, Eq. 5.

    `e_j` is a learned code per child slot shared by all anchors (decision 1), here directly its share of the
    first layer: the children of a new anchor have zero offsets and would otherwise be identical for ever.
    rho_can is relative to log s_a.
    """

    def __init__(self, config: SceneConfig) -> None:
        super().__init__()
        width = config.static_width
        self.from_feature = nn.Linear(config.feature_dim, width)
        self.from_offset = nn.Linear(3, width, bias=False)
        self.child_bias = nn.Parameter(torch.randn(config.children, width) * 0.1)
        self.out = nn.Linear(width, 7)
        with torch.no_grad():
            self.out.weight.mul_(0.1)
            self.out.bias.zero_()
            self.out.bias[4:] = math.log(INITIAL_SCALE)

    def forward(
        self,
        features: Float[Tensor, "anchor feature"],
        offsets: Float[Tensor, "drawn 3"],
        owners: Int64[Tensor, " drawn"],
        slots: Int64[Tensor, " drawn"],
    ) -> tuple[Float[Tensor, "drawn 4"], Float[Tensor, "drawn 3"]]:
        """Unit quaternions (w, x, y, z) and log-scales relative to log s_a of the drawn children."""
        first = torch.cat([self.from_feature.weight, self.from_offset.weight, self.child_bias.t()], dim=1)
        inputs = torch.cat([features.index_select(0, owners), offsets, one_hot(slots, self.child_bias)], dim=1)
        raw = perceptron(inputs, [first, self.out.weight], [self.from_feature.bias, self.out.bias])
        return canonical_attributes(raw)


def canonical_attributes(raw: Float[Tensor, "drawn 7"]) -> tuple[Float[Tensor, "drawn 4"], Float[Tensor, "drawn 3"]]:
    """Network output to (unit quaternion, relative log-scale): the identity rotation is the origin."""
    quats = raw[:, :4] + identity_quaternion(raw)
    return functional.normalize(quats, dim=-1, eps=1e-12), raw[:, 4:]
