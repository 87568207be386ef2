"""DeformNet: offsets of position, rotation and log-scale in time for each Gaussian (Eq. 7).

The stop-gradient of Eq. 7 is applied by `Scene`, which passes the positions.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from graings.config import SceneConfig
from graings.scene.children import Children
from graings.scene.encoding import encoding_width, frequency_encoding
from graings.scene.perceptron import GroupBias, perceptron, weights_and_biases


@dataclass(frozen=True, slots=True, eq=False)
class Deformation:
    """Offsets of N Gaussians at times that were evaluated together (Eq. 7): position, rotation and log-scale.

    Positions are in units of `extent` (the scene's half-size), in which learning rates do not depend on the size of the
    scene. The rotation is delta with Delta r = (1, 0, 0, 0) + delta up to its length, so that zero is no rotation.
    Log-scales are those before the clip of Eq. 10.
    """

    outputs: Float[Tensor, "gaussian time 10"]
    extent: float

    @property
    def units(self) -> Float[Tensor, " 10"]:
        """What each of the ten offsets is a multiple of."""
        return torch.tensor([self.extent] * 3 + [1.0] * 7, dtype=self.outputs.dtype)

    def position_offsets(self, index: int) -> Float[Tensor, "gaussian 3"]:
        """Delta x at time `index`, normalised units."""
        return self.outputs[:, index, :3] * self.extent

    def offsets(self, index: int) -> Float[Tensor, "gaussian 10"]:
        """Offsets at time `index`, positions in normalised units."""
        return self.outputs[:, index] * self.units


class DeformationNetwork(nn.Module):
    """(sg(x_can), gamma(t)) -> offsets [N, 10], Eq. 7; zero at initialization.

    With factorized `time_conditioning` it is W (phi(x) * psi(gamma(t))) + b: the hidden layers phi give each position
    its weights on `deform_width` motions, psi the amplitude of each motion at a time. psi is evaluated once per time,
    not once per Gaussian. With concatenated `time_conditioning` the encoded time is a further input of the first layer,
    added as a bias.
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
    ) -> Float[Tensor, "gaussian time 10"]:
        """Offsets for `positions` in units of the scene's extent at `times` in [0, 1].

        With factorized time the hidden layers run once for all times: each further time adds ten outputs.
        """
        encoded_positions = frequency_encoding(positions, self.position_frequencies)
        weights, biases = self._layers()
        if self.psi is not None:
            weights[-1], biases[-1] = self.output_layer(times)
            return perceptron(encoded_positions, weights, biases).unflatten(1, (len(times), -1))
        assert self.from_time is not None
        first, *others = biases
        return torch.stack(
            [
                perceptron(encoded_positions, weights, [first + from_time, *others])
                for from_time in self.from_time(frequency_encoding(times, self.time_frequencies))
            ],
            dim=1,
        )

    def hidden_units(self, positions: Float[Tensor, "gaussian 3"]) -> Float[Tensor, "gaussian width"]:
        """phi of `positions` in units of the scene's extent: what factorized offsets need beside `output_layer`."""
        weights, biases = self._layers()
        encoded = frequency_encoding(positions, self.position_frequencies)
        return perceptron(encoded, weights[:-1], biases[:-1]).relu()

    def output_layer(
        self, times: Float[Tensor, "time 1"]
    ) -> tuple[Float[Tensor, "output width"], Float[Tensor, " output"]]:
        """Weights W psi(t) and biases of factorized offsets, ten outputs for each of `times`, one after the other."""
        assert self.psi is not None
        amplitudes = self.psi(frequency_encoding(times, self.time_frequencies))
        return (self.out.weight * amplitudes.unsqueeze(1)).flatten(0, 1), self.out.bias.repeat(len(times))

    def _layers(self) -> tuple[list[Tensor], list[Tensor]]:
        return weights_and_biases([self.from_position, *self.hidden, self.out])


def time_modules(config: SceneConfig) -> tuple[nn.Linear | None, nn.Sequential | None]:
    """The layers of the encoded time: `from_time` for concatenated or `psi` for factorized time; the other is None."""
    width, time_width = config.deform_width, encoding_width(1, config.time_frequencies)
    if config.time_conditioning == "concatenated":
        return nn.Linear(time_width, width, bias=False), None
    hidden = config.time_width
    return None, nn.Sequential(nn.Linear(time_width, hidden), nn.ReLU(), nn.Linear(hidden, width))


class SingleMLP(nn.Module):
    """Ablation `single_mlp`: one network for canonical and temporal geometry.

    (f_a, eps_j, e_j, x_can, gamma(t)) -> [N, 17]: 7 outputs as those of StaticMLP, 10 as those of DeformationNetwork,
    with the same time conditioning.
    """

    def __init__(self, config: SceneConfig, initial_log_scale: float) -> None:
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
            self.out.bias[4:7] = initial_log_scale

    def forward(
        self,
        features: Float[Tensor, "anchor feature"],
        children: Children,
        positions: Float[Tensor, "gaussian 3"],
        time: Tensor | None,
    ) -> Float[Tensor, "gaussian 17"]:
        """Outputs for `children` at `positions` in units of the scene's extent; `time` is None during the warm-up."""
        first = [self.from_offset.weight, self.child_bias.t(), self.from_position.weight]
        inputs = [children.inputs, frequency_encoding(positions, self.position_frequencies)]
        shared = perceptron(features, [self.from_feature.weight], [self.from_feature.bias])
        weights, biases = weights_and_biases([*self.hidden, self.out])
        weights, biases = [torch.cat(first, dim=1), *weights], [torch.zeros_like(self.from_feature.bias), *biases]
        encoded_time = None if time is None else frequency_encoding(time, self.time_frequencies)
        if encoded_time is not None and self.from_time is not None:
            biases[0] = biases[0] + self.from_time(encoded_time)
        if encoded_time is not None and self.psi is not None:
            canonical, temporal = weights[-1].split([7, 10])
            weights[-1] = torch.cat([canonical, temporal * self.psi(encoded_time)])
        return perceptron(torch.cat(inputs, dim=1), weights, biases, shared=GroupBias(shared, children.anchors))
