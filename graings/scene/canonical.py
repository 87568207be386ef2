"""Canonical geometry of the children: rotation and log-scale from StaticMLP (Eq. 5).

Knows nothing of time, viewing direction or pixels.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from graings.config import SceneConfig
from graings.scene.children import Children
from graings.scene.perceptron import GroupBias, perceptron

# A child starts with about half the spacing of its neighbours as standard deviation: they overlap, but
# none hides the next (decision 12).
INITIAL_SCALE = 0.5


class StaticMLP(nn.Module):
    """(f_a, eps_j, e_j) -> (r_can, rho_can) for each child by itself, Eq. 5.

    `e_j` is a learned code per child slot shared by all anchors (decision 1), here directly its share of the
    first layer: the children of a new anchor have zero offsets and would otherwise be identical for ever.
    rho_can is relative to log s_a. The feature's share of the first layer is computed once per anchor.
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

    def forward(self, features: Float[Tensor, "anchor feature"], drawn: Children) -> Float[Tensor, "drawn 7"]:
        """Quaternion less the identity and log-scale less log s_a of the drawn children."""
        first = torch.cat([self.from_offset.weight, self.child_bias.t()], dim=1)
        shared = perceptron(features, [self.from_feature.weight], [self.from_feature.bias])
        none = torch.zeros_like(self.from_feature.bias)
        weights, biases = [first, self.out.weight], [none, self.out.bias]
        return perceptron(drawn.inputs, weights, biases, shared=GroupBias(shared, drawn.anchors))


def default_geometry(children: Float[Tensor, "drawn 3"]) -> Float[Tensor, "drawn 7"]:
    """What StaticMLP's answer is where there is none: no rotation, the initial scale."""
    answer = children.new_zeros(len(children), 7)
    answer[:, 4:] = math.log(INITIAL_SCALE)
    return answer
