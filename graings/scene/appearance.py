"""Appearance: canonical colour and opacity heads (Eq. 11) and the bounded temporal residual (Eq. 12).

Every head is evaluated once per anchor and outputs one value per child slot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from graings.config import SceneConfig
from graings.scene.activations import tanh
from graings.scene.encoding import (
    direction_encoding,
    direction_width,
    encoding_width,
    frequency_encoding,
)
from graings.scene.perceptron import GroupBias, perceptron, weights_and_biases


@dataclass(frozen=True, slots=True, eq=False)
class ColorPart:
    """What the colour head needs of each anchor's feature: the same for all views."""

    hidden: GroupBias  # the feature's part of the first layer, bias included; a group for each anchor
    normals: Float[Tensor, "anchor 3"] | None  # at which the viewing direction is reflected


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

    def color_part(self, features: Float[Tensor, "anchor feature"]) -> ColorPart:
        """What `color_logits` needs of the features, for any number of views."""
        first = self.color[0]
        assert isinstance(first, nn.Linear)
        hidden = perceptron(features, [first.weight[:, : features.shape[-1]]], [first.bias])
        return ColorPart(_per_row(hidden), None if self.normal is None else self.normal(features))

    def color_layers(self, part: ColorPart) -> tuple[list[Tensor], list[Tensor]]:
        """Weights and biases that remain of the colour head once the features' part of its first layer is known."""
        weights, biases = weights_and_biases(self.color)
        encodings = 1 if part.normals is None else 2
        directions = encodings * direction_width(self.color_sh_degree)
        return [weights[0][:, -directions:], weights[1]], [torch.zeros_like(biases[0]), biases[1]]

    def color_logits(self, part: ColorPart, directions: Float[Tensor, "anchor 3"]) -> Float[Tensor, "slot 3"]:
        """F_c of Eq. 11 before the sigmoid, for every child slot."""
        inputs = direction_encoding(directions, self.color_sh_degree, part.normals)
        return perceptron(inputs, *self.color_layers(part), shared=part.hidden).view(-1, 3)

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

    def opacity_rounding(self, features: Float[Tensor, "anchor feature"]) -> Float[Tensor, "anchor child"]:
        """Upper bound of the rounding errors of `opacity_logits` and `highest_opacity_logits` together.

        A sum of n products is off by at most n u / (1 - n u) times the sum of their magnitudes, u half of `eps`; ReLU
        passes an error on unchanged, so those of two layers add up to n_1 + n_2 times the magnitudes through both.
        """
        weights, biases = [[tensor.abs() for tensor in tensors] for tensors in weights_and_biases(self.opacity)]
        width = features.shape[-1]
        first = features.abs() @ weights[0][:, :width].T + weights[0][:, width:].norm(dim=-1) + biases[0]
        terms = sum(weight.shape[1] + 4 for weight in weights)  # biases and the length of the direction besides
        magnitudes: Tensor = first @ weights[1].T + biases[1]
        return 2 * terms * torch.finfo(features.dtype).eps * magnitudes


class TemporalHead(nn.Module):
    """A network with one hidden layer and the encoded time as a further input; its output is zero at initialization.

    The features' part of the hidden layer is computed once for all times and directions, the time's part once for all
    rows.
    """

    def __init__(self, config: SceneConfig, inputs: int, outputs: int) -> None:
        super().__init__()
        self.from_feature = nn.Linear(inputs, config.head_width)
        self.from_time = nn.Linear(encoding_width(1, config.time_frequencies), config.head_width, bias=False)
        self.out = nn.Linear(config.head_width, outputs)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def feature_part(self, features: Float[Tensor, "row feature"]) -> GroupBias:
        """The features' part of the hidden layer, bias included: the same for all times and directions."""
        weight = self.from_feature.weight[:, : features.shape[-1]]
        return _per_row(perceptron(features, [weight], [self.from_feature.bias]))

    def other_weights(self, others: int) -> list[Tensor]:
        """Weights that remain once the part of the features is known; the last `others` inputs are not features."""
        first = self.from_feature.weight
        return [first[:, first.shape[1] - others :], self.out.weight]

    def biases(self, encoded_time: Float[Tensor, " time"]) -> list[Tensor]:
        """The biases that go with `other_weights` at a time."""
        return [self.from_time(encoded_time), self.out.bias]

    def predict(
        self,
        part: GroupBias,
        encoded_time: Float[Tensor, " time"],
        others: Float[Tensor, "row other"] | None = None,
    ) -> Float[Tensor, "row output"]:
        """The output for each row of `feature_part`, with further inputs, at the time encoded by `encoded_time`."""
        inputs = part.values.new_empty(len(part.values), 0) if others is None else others
        return perceptron(inputs, self.other_weights(inputs.shape[1]), self.biases(encoded_time), shared=part)


@dataclass(frozen=True, slots=True, eq=False)
class ResidualPart:
    """What the residual needs of each anchor's feature: the same for all times and views."""

    time_only: GroupBias
    seeing: GroupBias | None

    def of_anchors(self, first: int, last: int) -> ResidualPart:
        """The part of the anchors from `first` to before `last`."""
        parts = [None if part is None else _per_row(part.values[first:last]) for part in (self.time_only, self.seeing)]
        assert parts[0] is not None
        return ResidualPart(parts[0], parts[1])


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

    def part(self, features: Float[Tensor, "anchor feature"]) -> ResidualPart:
        """What the residual needs of the features, for any number of times and views."""
        return ResidualPart(
            self.feature_part(features), None if self.seeing is None else self.seeing.feature_part(features)
        )

    def forward(
        self, part: ResidualPart, time: Float[Tensor, " 1"], directions: Float[Tensor, "anchor 3"]
    ) -> Float[Tensor, "anchor child 4"]:
        """(Delta c, Delta o) of every slot at `time` in [0, 1], before the bound eta tanh of Eq. 12."""
        return self.of_directions(part, time, [directions])[0]

    def of_directions(
        self, part: ResidualPart, time: Float[Tensor, " 1"], directions: Sequence[Float[Tensor, "anchor 3"]]
    ) -> Float[Tensor, "view anchor child 4"]:
        """As `forward` for several views of one time; one if nothing depends on the view."""
        encoded_time = self.encoded(time)
        time_only = self.predict(part.time_only, encoded_time)
        if self.seeing is None or part.seeing is None:
            return time_only.unflatten(-1, (-1, 4)).unsqueeze(0)
        count = len(directions)
        hidden = part.seeing if count == 1 else _per_row(part.seeing.values.repeat(count, 1))
        encoded = direction_encoding(torch.cat(list(directions)), self.sh_degree)
        view_dependent = self.seeing.predict(hidden, encoded_time, encoded).view(count, *time_only.shape, 3)
        opacity = time_only.unsqueeze(-1).expand(count, -1, -1, 1)
        return torch.cat([view_dependent, opacity], dim=-1)

    def encoded(self, time: Float[Tensor, " 1"]) -> Float[Tensor, " width"]:
        """gamma(t), which both heads receive."""
        return frequency_encoding(time, self.time_frequencies)

    def bounded(self, raw: Float[Tensor, "*rows"]) -> Float[Tensor, "*rows"]:
        """eta tanh(`raw`), within (-eta, eta), Eq. 12."""
        return self.scale * tanh(raw)


def _per_row(values: Float[Tensor, "row width"]) -> GroupBias:
    """A bias of the first layer for each row."""
    return GroupBias(values, torch.arange(len(values)))
