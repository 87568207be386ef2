"""Appearance: canonical colour and opacity heads (Eq. 11) and the bounded temporal residual (Eq. 12).

All heads run once per anchor and give one value per child slot (decision 1). Knows nothing of geometry,
time encoding aside, or of pixels.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from graings.config import SceneConfig
from graings.scene.encoding import (
    direction_encoding,
    direction_width,
    encoding_width,
    frequency_encoding,
)
from graings.scene.perceptron import perceptron, weights_and_biases
from graings.scene.saturate import sigmoid, tanh


class CanonicalAppearance(nn.Module):
    """F_c and F_o: (f_a, v) -> colour in (0, 1) and opacity score in (-1, 1) per child slot, Eq. 11.

    F_c sees v as spherical harmonics up to `color_sh_degree`: a highlight is narrower than what one hidden layer makes
    of the direction itself. With `reflection` it also sees v mirrored at a normal, a linear function of f_a: all of a
    curved surface then has its highlight where that direction meets the light. With `opacity_view` off F_o sees the
    feature only: in a monocular capture the viewing direction names the frame, and opacity could then switch children
    per frame instead of moving them (decision 8).
    """

    def __init__(self, config: SceneConfig, initial_opacity: float) -> None:
        super().__init__()
        k, width = config.children, config.head_width
        self.opacity_view = config.opacity_view
        self.color_sh_degree = config.color_sh_degree
        seen = 2 if config.reflection else 1
        color_inputs = config.feature_dim + seen * direction_width(config.color_sh_degree)
        self.color = nn.Sequential(nn.Linear(color_inputs, width), nn.ReLU(), nn.Linear(width, 3 * k))
        opacity_inputs = config.feature_dim + (3 if config.opacity_view else 0)
        self.opacity = nn.Sequential(nn.Linear(opacity_inputs, width), nn.ReLU(), nn.Linear(width, k))
        self.normal = nn.Linear(config.feature_dim, 3) if config.reflection else None
        last = self.opacity[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight.mul_(0.1)  # all children start near the same, visible, opacity (A18)
            last.bias.fill_(math.atanh(initial_opacity))

    def colors(
        self,
        features: Float[Tensor, "anchor feature"],
        directions: Float[Tensor, "anchor 3"],
        children: Int64[Tensor, " drawn"],
    ) -> Float[Tensor, "drawn 3"]:
        """c_can of the given flat child slots (anchor * k + child)."""
        normals = None if self.normal is None else self.normal(features)
        inputs = torch.cat([features, direction_encoding(directions, self.color_sh_degree, normals)], dim=-1)
        raw = perceptron(inputs, *weights_and_biases(self.color))
        return sigmoid(raw.view(-1, 3).index_select(0, children))

    def opacity_logits(
        self, features: Float[Tensor, "anchor feature"], directions: Float[Tensor, "anchor 3"]
    ) -> Float[Tensor, "anchor child"]:
        """F_o before the tanh, for every child slot."""
        inputs = torch.cat([features, directions], dim=-1) if self.opacity_view else features
        return perceptron(inputs, *weights_and_biases(self.opacity))

    def highest_opacity_logits(self, features: Float[Tensor, "anchor feature"]) -> Float[Tensor, "anchor child"]:
        """A bound of `opacity_logits` over all viewing directions; without them, `opacity_logits` itself.

        A unit vector moves what enters a hidden unit by no more than the length of its weights, and each weight of the
        last layer then meets the end that suits it.
        """
        weights, biases = weights_and_biases(self.opacity)
        middle = features @ weights[0][:, : features.shape[-1]].T + biases[0]
        reach = weights[0][:, features.shape[-1] :].norm(dim=-1)
        least, most = (middle - reach).relu(), (middle + reach).relu()
        highest: Tensor = most @ weights[1].clamp_min(0).T + least @ weights[1].clamp_max(0).T + biases[1]
        return highest


class TemporalHead(nn.Module):
    """One hidden layer, which the encoded time enters once for all rows; its answer is zero at birth."""

    def __init__(self, config: SceneConfig, inputs: int, outputs: int) -> None:
        super().__init__()
        self.from_feature = nn.Linear(inputs, config.head_width)
        self.from_time = nn.Linear(encoding_width(1, config.time_frequencies), config.head_width, bias=False)
        self.out = nn.Linear(config.head_width, outputs)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def answer(self, rows: Float[Tensor, "row input"], moment: Float[Tensor, " time"]) -> Float[Tensor, "row output"]:
        """For `rows` at the time whose encoding is `moment`."""
        biases = [self.from_feature.bias + self.from_time(moment), self.out.bias]
        return perceptron(rows, [self.from_feature.weight, self.out.weight], biases)


class ResidualField(TemporalHead):
    """F_res: (f_a, gamma(t)) -> (Delta c, Delta o) per child slot, Eq. 12; zero at birth.

    With `residual_sh_degree` a second head gives Delta c and also gets the viewing direction as spherical harmonics
    up to that degree: what shines, or lets light through, changes in time by another amount from every side. Delta o
    never is (decision 8). What `forward` gives is still to be bounded by `bounded`: few slots are drawn, and only they
    need all of it.
    """

    def __init__(self, config: SceneConfig) -> None:
        seen = direction_width(config.residual_sh_degree)
        super().__init__(config, config.feature_dim, config.children * (1 if seen else 4))
        self.scale = config.residual_scale
        self.time_frequencies = config.time_frequencies
        self.degree = config.residual_sh_degree
        self.seeing = TemporalHead(config, config.feature_dim + seen, 3 * config.children) if seen else None

    def forward(
        self,
        features: Float[Tensor, "anchor feature"],
        time: Float[Tensor, " 1"],
        directions: Float[Tensor, "anchor 3"],
    ) -> Float[Tensor, "anchor child 4"]:
        """(Delta c, Delta o) of every slot at `time` in [0, 1], unbounded."""
        moment = frequency_encoding(time, self.time_frequencies)
        blind = self.answer(features, moment)
        if self.seeing is None:
            return blind.unflatten(-1, (-1, 4))
        rows = torch.cat([features, direction_encoding(directions, self.degree)], dim=-1)
        return torch.cat([self.seeing.answer(rows, moment).unflatten(-1, (-1, 3)), blind.unsqueeze(-1)], dim=-1)

    def bounded(self, raw: Float[Tensor, "*rows"]) -> Float[Tensor, "*rows"]:
        """`raw` within (-eta, eta)."""
        return self.scale * tanh(raw)
