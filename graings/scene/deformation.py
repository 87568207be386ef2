"""DeformationNetwork: an offset in time for each Gaussian (Eq. 7), and how it is applied (Eq. 10).

Knows nothing of anchors, appearance, cameras or pixels. Whether its positions are detached is the scene's
decision, not this module's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from graings.config import SceneConfig
from graings.scene.canonical import INITIAL_SCALE, identity_quaternion, one_hot
from graings.scene.clip import clip
from graings.scene.encoding import encoding_width, frequency_encoding
from graings.scene.perceptron import perceptron, weights_and_biases

# Bound on the change of a log-scale in time (Eq. 10).
LOG_SCALE_BOUND = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Deformation:
    """Raw offsets of N Gaussians at one time.

    `rotation` is delta with Delta r = normalise((1, 0, 0, 0) + delta) (decision 11); `log_scales` is not yet
    clipped.
    """

    position: Float[Tensor, "gaussian 3"]
    rotation: Float[Tensor, "gaussian 4"]
    log_scales: Float[Tensor, "gaussian 3"]

    def apply(
        self,
        means: Float[Tensor, "gaussian 3"],
        quats: Float[Tensor, "gaussian 4"],
        log_scales: Float[Tensor, "gaussian 3"],
        *,
        projected_clip: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Deformed (means, quats, log_scales), Eq. 10."""
        bounded = clip(self.log_scales, -LOG_SCALE_BOUND, LOG_SCALE_BOUND, projected=projected_clip)
        turn = self.rotation + identity_quaternion(self.rotation)
        return means + self.position, quaternion_product(quats, turn), log_scales + bounded


def deformation_from(raw: Float[Tensor, "gaussian 10"], extent: Tensor) -> Deformation:
    """Network output to offsets; positions come in units of the scene's extent, so rates need no length."""
    return Deformation(raw[:, :3] * extent, raw[:, 3:7], raw[:, 7:10])


def quaternion_product(a: Float[Tensor, "gaussian 4"], b: Float[Tensor, "gaussian 4"]) -> Float[Tensor, "gaussian 4"]:
    """Hamilton product of (w, x, y, z) quaternions, not normalised (the rasterizer does that once)."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


class DeformationNetwork(nn.Module):
    """(position, gamma(t)) -> raw offsets [N, 10]; exactly zero at birth.

    Time enters the first layer as a bias: one small product per frame instead of a wider input per Gaussian.
    """

    def __init__(self, config: SceneConfig) -> None:
        super().__init__()
        self.position_frequencies = config.position_frequencies
        self.time_frequencies = config.time_frequencies
        width = config.deform_width
        self.from_position = nn.Linear(encoding_width(3, config.position_frequencies), width)
        self.from_time = nn.Linear(encoding_width(1, config.time_frequencies), width, bias=False)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(config.deform_depth - 1))
        self.out = nn.Linear(width, 10)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, positions: Float[Tensor, "gaussian 3"], time: Float[Tensor, 1]) -> Float[Tensor, "gaussian 10"]:
        """`positions` in units of the scene's extent, `time` in [0, 1]."""
        encoded = frequency_encoding(positions, self.position_frequencies)
        bias = self.from_position.bias + self.from_time(frequency_encoding(time, self.time_frequencies))
        rest = weights_and_biases([*self.hidden, self.out])
        return perceptron(encoded, [self.from_position.weight, *rest[0]], [bias, *rest[1]])


class SingleMLP(nn.Module):
    """Ablation `single_mlp`: one network for canonical and temporal geometry.

    (f_a, eps_j, e_j, position, gamma(t)) -> [N, 17]: 7 canonical outputs as StaticMLP's, 10 as
    DeformationNetwork's. Without a time (`time` None, warm-up) the time input is absent.
    """

    def __init__(self, config: SceneConfig) -> None:
        super().__init__()
        self.position_frequencies = config.position_frequencies
        self.time_frequencies = config.time_frequencies
        width = config.deform_width
        self.from_feature = nn.Linear(config.feature_dim, width)
        self.from_offset = nn.Linear(3, width, bias=False)
        self.child_bias = nn.Parameter(torch.randn(config.children, width) * 0.1)
        self.from_position = nn.Linear(encoding_width(3, config.position_frequencies), width, bias=False)
        self.from_time = nn.Linear(encoding_width(1, config.time_frequencies), width, bias=False)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(config.deform_depth - 1))
        self.out = nn.Linear(width, 17)
        with torch.no_grad():
            self.out.weight.mul_(0.1)
            self.out.weight[7:].zero_()
            self.out.bias.zero_()
            self.out.bias[4:7] = math.log(INITIAL_SCALE)

    def forward(
        self, features: Tensor, offsets: Tensor, owners: Tensor, slots: Tensor, positions: Tensor, time: Tensor | None
    ) -> Float[Tensor, "gaussian 17"]:
        """Raw outputs of the drawn children; arguments as in StaticMLP and DeformationNetwork."""
        weights = [self.from_feature.weight, self.from_offset.weight, self.child_bias.t(), self.from_position.weight]
        inputs = [
            features.index_select(0, owners),
            offsets,
            one_hot(slots, self.child_bias),
            frequency_encoding(positions, self.position_frequencies),
        ]
        bias = self.from_feature.bias
        if time is not None:
            bias = bias + self.from_time(frequency_encoding(time, self.time_frequencies))
        rest = weights_and_biases([*self.hidden, self.out])
        return perceptron(torch.cat(inputs, dim=1), [torch.cat(weights, dim=1), *rest[0]], [bias, *rest[1]])
