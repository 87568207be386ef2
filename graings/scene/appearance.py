"""Appearance: canonical colour and opacity heads (Eq. 11) and the bounded temporal residual (Eq. 12).

Every head is evaluated once per anchor and outputs one value per child slot.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from graings.config import SceneConfig
from graings.scene.activations import sigmoid, tanh
from graings.scene.encoding import (
    direction_encoding,
    direction_width,
    encoding_width,
    frequency_encoding,
)
from graings.scene.perceptron import perceptron, weights_and_biases


class CanonicalAppearance(nn.Module):
    """F_c and F_o of Eq. 11: (f_a, v) -> colour in (0, 1) and opacity score in (-1, 1) per child slot.

    F_c receives v as spherical harmonics up to `color_sh_degree`, because one hidden layer cannot form a narrow
    highlight from the direction itself. With `reflection` it also receives v reflected at a normal that is a linear
    function of f_a: a curved surface then has its highlight wherever the reflected direction meets the light. Without
    `opacity_view` F_o receives the feature only: in a monocular capture the viewing direction identifies the frame, so
    opacity could switch children on and off per frame instead of moving them.
    """

    def __init__(self, config: SceneConfig, initial_opacity: float) -> None:
        super().__init__()
        k, width = config.children, config.head_width
        self.opacity_view = config.opacity_view
        self.color_sh_degree = config.color_sh_degree
        encodings = 2 if config.reflection else 1
        color_inputs = config.feature_dim + encodings * direction_width(config.color_sh_degree)
        self.color = nn.Sequential(nn.Linear(color_inputs, width), nn.ReLU(), nn.Linear(width, 3 * k))
        opacity_inputs = config.feature_dim + (3 if config.opacity_view else 0)
        self.opacity = nn.Sequential(nn.Linear(opacity_inputs, width), nn.ReLU(), nn.Linear(width, k))
        self.normal = nn.Linear(config.feature_dim, 3) if config.reflection else None
        last = self.opacity[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight.mul_(0.1)  # all children start with nearly the same opacity, above the rendering threshold
            last.bias.fill_(math.atanh(initial_opacity))

    def colors(
        self,
        features: Float[Tensor, "anchor feature"],
        directions: Float[Tensor, "anchor 3"],
        children: Int64[Tensor, " gaussian"],
    ) -> Float[Tensor, "gaussian 3"]:
        """c_can (Eq. 11) of the given flat child slots (anchor * k + child)."""
        normals = None if self.normal is None else self.normal(features)
        inputs = torch.cat([features, direction_encoding(directions, self.color_sh_degree, normals)], dim=-1)
        raw = perceptron(inputs, *weights_and_biases(self.color))
        return sigmoid(raw.view(-1, 3).index_select(0, children))

    def opacity_logits(
        self, features: Float[Tensor, "anchor feature"], directions: Float[Tensor, "anchor 3"]
    ) -> Float[Tensor, "anchor child"]:
        """F_o of Eq. 11 before the tanh, for every child slot."""
        inputs = torch.cat([features, directions], dim=-1) if self.opacity_view else features
        return perceptron(inputs, *weights_and_biases(self.opacity))

    def highest_opacity_logits(self, features: Float[Tensor, "anchor feature"]) -> Float[Tensor, "anchor child"]:
        """Upper bound of `opacity_logits` over all viewing directions; equal to it without `opacity_view`.

        Interval arithmetic: a unit vector changes the input of a hidden unit by at most the norm of its weights for the
        direction; each weight of the last layer then takes the end of the interval that gives the larger sum.
        """
        weights, biases = weights_and_biases(self.opacity)
        middle = features @ weights[0][:, : features.shape[-1]].T + biases[0]
        radius = weights[0][:, features.shape[-1] :].norm(dim=-1)
        lowest, highest = (middle - radius).relu(), (middle + radius).relu()
        bound: Tensor = highest @ weights[1].clamp_min(0).T + lowest @ weights[1].clamp_max(0).T + biases[1]
        return bound


class TemporalHead(nn.Module):
    """A network with one hidden layer and the encoded time as a further input; its output is zero at initialization.

    The time's part of the hidden layer is computed once and added as a bias for all rows.
    """

    def __init__(self, config: SceneConfig, inputs: int, outputs: int) -> None:
        super().__init__()
        self.from_feature = nn.Linear(inputs, config.head_width)
        self.from_time = nn.Linear(encoding_width(1, config.time_frequencies), config.head_width, bias=False)
        self.out = nn.Linear(config.head_width, outputs)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def predict(
        self, inputs: Float[Tensor, "row input"], encoded_time: Float[Tensor, " time"]
    ) -> Float[Tensor, "row output"]:
        """The output for each row of `inputs` at the time whose encoding is `encoded_time`."""
        biases = [self.from_feature.bias + self.from_time(encoded_time), self.out.bias]
        return perceptron(inputs, [self.from_feature.weight, self.out.weight], biases)


class ResidualField(TemporalHead):
    """F_res of Eq. 12: (f_a, gamma(t)) -> (Delta c, Delta o) per child slot; zero at initialization.

    With `residual_sh_degree` a second, view-dependent head (`seeing`) predicts Delta c and also receives the viewing
    direction as spherical harmonics up to that degree: the change of a specular or translucent surface in time depends
    on the viewing direction. Delta o always comes from the time-only head, for the same reason as F_o has no
    direction. `forward` returns raw values; `bounded` is applied only to those that are needed, because few slots
    are rendered.
    """

    def __init__(self, config: SceneConfig) -> None:
        view_inputs = direction_width(config.residual_sh_degree)
        super().__init__(config, config.feature_dim, config.children * (1 if view_inputs else 4))
        self.scale = config.residual_scale
        self.time_frequencies = config.time_frequencies
        self.sh_degree = config.residual_sh_degree
        self.seeing = (
            TemporalHead(config, config.feature_dim + view_inputs, 3 * config.children) if view_inputs else None
        )

    def forward(
        self,
        features: Float[Tensor, "anchor feature"],
        time: Float[Tensor, " 1"],
        directions: Float[Tensor, "anchor 3"],
    ) -> Float[Tensor, "anchor child 4"]:
        """(Delta c, Delta o) of every slot at `time` in [0, 1], before the bound eta tanh of Eq. 12."""
        encoded_time = frequency_encoding(time, self.time_frequencies)
        time_only = self.predict(features, encoded_time)
        if self.seeing is None:
            return time_only.unflatten(-1, (-1, 4))
        inputs = torch.cat([features, direction_encoding(directions, self.sh_degree)], dim=-1)
        view_dependent = self.seeing.predict(inputs, encoded_time).unflatten(-1, (-1, 3))
        return torch.cat([view_dependent, time_only.unsqueeze(-1)], dim=-1)

    def bounded(self, raw: Float[Tensor, "*rows"]) -> Float[Tensor, "*rows"]:
        """eta tanh(`raw`), within (-eta, eta), Eq. 12."""
        return self.scale * tanh(raw)
