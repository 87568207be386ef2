"""Canonical geometry of the child Gaussians: rotation and log-scale from StaticMLP (Eq. 5)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from graings.config import SceneConfig
from graings.scene.children import Children
from graings.scene.perceptron import GroupBias, perceptron

# Initial standard deviation of a child in units of s_a, the spacing of its neighbours: Gaussians overlap, but none
# covers the next one completely.
INITIAL_SCALE = 0.5


class StaticMLP(nn.Module):
    """(f_a, eps_j, e_j) -> (r_can, rho_can) for each child independently, Eq. 5.

    `e_j` is a learned code per child slot that all anchors share; it is stored directly as its part of the first
    layer. Without it the children of a new anchor, whose offsets are all zero, would stay identical. Log-scales start
    at `initial_log_scale`. The feature's part of the first layer is computed once per anchor.
    """

    def __init__(self, config: SceneConfig, initial_log_scale: float) -> None:
        super().__init__()
        width = config.static_width
        self.from_feature = nn.Linear(config.feature_dim, width)
        self.from_offset = nn.Linear(3, width, bias=False)
        self.child_bias = nn.Parameter(torch.randn(config.children, width) * 0.1)
        self.out = nn.Linear(width, 7)
        with torch.no_grad():
            self.out.weight.mul_(0.1)
            self.out.bias.zero_()
            self.out.bias[4:] = initial_log_scale

    def forward(self, features: Float[Tensor, "anchor feature"], children: Children) -> Float[Tensor, "gaussian 7"]:
        """Of each child: quaternion minus the identity (1, 0, 0, 0), and log-scale minus that of its unit."""
        first = torch.cat([self.from_offset.weight, self.child_bias.t()], dim=1)
        shared = perceptron(features, [self.from_feature.weight], [self.from_feature.bias])
        zero_bias = torch.zeros_like(self.from_feature.bias)
        weights, biases = [first, self.out.weight], [zero_bias, self.out.bias]
        return perceptron(children.inputs, weights, biases, shared=GroupBias(shared, children.anchors))


def default_geometry(canonical_means: Float[Tensor, "gaussian 3"]) -> Float[Tensor, "gaussian 7"]:
    """The canonical geometry of a scene without StaticMLP (ablation): identity rotation and the initial scale."""
    geometry = canonical_means.new_zeros(len(canonical_means), 7)
    geometry[:, 4:] = math.log(INITIAL_SCALE)
    return geometry
