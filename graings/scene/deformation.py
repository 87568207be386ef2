"""DeformationNetwork: an offset in time for each Gaussian (Eq. 7).

Knows nothing of appearance, cameras or pixels. Whether its positions are detached is the scene's
decision, not this module's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from graings.config import SceneConfig
from graings.scene.canonical import INITIAL_SCALE
from graings.scene.children import Children
from graings.scene.encoding import encoding_width, frequency_encoding
from graings.scene.perceptron import GroupBias, perceptron, weights_and_biases


@dataclass(frozen=True, slots=True, eq=False)
class Deformation:
    """Raw offsets of N Gaussians at one time: of position (normalised units), rotation and log-scales.

    Rotation is delta with Delta r = normalise((1, 0, 0, 0) + delta) (decision 11); log-scales are not yet clipped.
    """

    offsets: Float[Tensor, "gaussian 10"]

    @property
    def position(self) -> Float[Tensor, "gaussian 3"]:
        """What is added to the canonical position."""
        return self.offsets[:, :3]


def deformation_from(raw: Float[Tensor, "gaussian 10"], extent: float) -> Deformation:
    """Network output to offsets; positions come in units of the scene's extent, so rates need no length."""
    return Deformation(raw * torch.tensor([extent] * 3 + [1.0] * 7, dtype=raw.dtype))


class DeformationNetwork(nn.Module):
    """(position, gamma(t)) -> raw offsets [N, 10]; exactly zero at birth.

    With `time_conditioning` factorized it is W (phi(x) * psi(gamma(t))) + b: the hidden layers give each position its
    weights on `deform_width` motions, psi the amplitude of each motion at the time. All positions of a frame share
    psi, so it costs one row. With concatenated the encoded time is a further input of the first layer, added as a bias.
    """

    def __init__(self, config: SceneConfig) -> None:
        super().__init__()
        self.position_frequencies = config.position_frequencies
        self.time_frequencies = config.time_frequencies
        width = config.deform_width
        self.from_position = nn.Linear(encoding_width(3, config.position_frequencies), width)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(config.deform_depth - 1))
        self.out = nn.Linear(width, 10)
        self.from_time, self.psi = time_modules(config)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(
        self, positions: Float[Tensor, "gaussian 3"], times: Float[Tensor, "time 1"]
    ) -> Float[Tensor, "time gaussian 10"]:
        """`positions` in units of the scene's extent, `times` in [0, 1].

        In a product a further time is ten further outputs: the hidden layers run once.
        """
        encoded = frequency_encoding(positions, self.position_frequencies)
        moments = frequency_encoding(times, self.time_frequencies)
        weights, biases = weights_and_biases([self.from_position, *self.hidden, self.out])
        if self.psi is not None:
            weights[-1] = (weights[-1] * self.psi(moments).unsqueeze(1)).flatten(0, 1)
            biases[-1] = biases[-1].repeat(len(times))
            return perceptron(encoded, weights, biases).unflatten(1, (len(times), -1)).transpose(0, 1)
        assert self.from_time is not None
        first, *others = biases
        return torch.stack(
            [perceptron(encoded, weights, [first + shift, *others]) for shift in self.from_time(moments)]
        )


def time_modules(config: SceneConfig) -> tuple[nn.Linear | None, nn.Sequential | None]:
    """What encoded time goes through: to the first layer as a bias, or to the last one as weights; one of the two."""
    width, time_width = config.deform_width, encoding_width(1, config.time_frequencies)
    if config.time_conditioning == "concatenated":
        return nn.Linear(time_width, width, bias=False), None
    hidden = config.time_width
    return None, nn.Sequential(nn.Linear(time_width, hidden), nn.ReLU(), nn.Linear(hidden, width))


class SingleMLP(nn.Module):
    """Ablation `single_mlp`: one network for canonical and temporal geometry.

    (f_a, eps_j, e_j, position, gamma(t)) -> [N, 17]: 7 canonical outputs as StaticMLP's, 10 as
    DeformationNetwork's, into which time enters as there. Without a time (`time` None, warm-up) it does not.
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
        self.from_time, self.psi = time_modules(config)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(config.deform_depth - 1))
        self.out = nn.Linear(width, 17)
        with torch.no_grad():
            self.out.weight.mul_(0.1)
            self.out.weight[7:].zero_()
            self.out.bias.zero_()
            self.out.bias[4:7] = math.log(INITIAL_SCALE)

    def forward(
        self,
        features: Float[Tensor, "anchor feature"],
        drawn: Children,
        positions: Float[Tensor, "gaussian 3"],
        time: Tensor | None,
    ) -> Float[Tensor, "gaussian 17"]:
        """Raw outputs of the drawn children: the first two as in StaticMLP, the rest as in DeformationNetwork."""
        first = [self.from_offset.weight, self.child_bias.t(), self.from_position.weight]
        everything = [drawn.inputs, frequency_encoding(positions, self.position_frequencies)]
        shared = perceptron(features, [self.from_feature.weight], [self.from_feature.bias])
        weights, biases = weights_and_biases([*self.hidden, self.out])
        weights, biases = [torch.cat(first, dim=1), *weights], [torch.zeros_like(self.from_feature.bias), *biases]
        moment = None if time is None else frequency_encoding(time, self.time_frequencies)
        if moment is not None and self.from_time is not None:
            biases[0] = biases[0] + self.from_time(moment)
        if moment is not None and self.psi is not None:
            canonical, temporal = weights[-1].split([7, 10])
            weights[-1] = torch.cat([canonical, temporal * self.psi(moment)])
        return perceptron(torch.cat(everything, dim=1), weights, biases, shared=GroupBias(shared, drawn.anchors))
