"""The colours of a prepared scene: what is left of the heads of colour and residual for one view (Eq. 11 to 13)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import ArrayLike
from torch import Tensor

from graings import constants, kernel
from graings.scene.appearance import ResidualField
from graings.scene.encoding import direction_width
from graings.scene.scene import Scene


class PreparedColors:
    """Colours of the children of `anchors` (indices) of `scene`, whose features are `features`."""

    def __init__(
        self, scene: Scene, anchors: Int64[Tensor, " anchor"], features: Float[Tensor, "anchor feature"]
    ) -> None:
        self._appearance, self._residual = scene.appearance, scene.residual if scene.temporal else None
        self._positions = scene.scaffold.anchors.index_select(0, anchors)
        self._part = scene.appearance.color_part(features)
        self._layers = scene.appearance.color_layers(self._part)
        self._residual_part = None if self._residual is None else self._residual.part(features)

    def changes(
        self, residual: ResidualField, time: float
    ) -> tuple[Float[Tensor, "anchor child"], Float[Tensor, "anchor child 4"] | None]:
        """Delta o of every slot at `time` before its bound, and (Delta c, Delta o) where Delta c has no direction."""
        assert self._residual_part is not None
        encoded_time = residual.encoded(self._positions.new_tensor([time]))
        raw = residual.predict(self._residual_part.time_only, encoded_time)
        if residual.seeing is not None:
            return raw, None
        both = raw.unflatten(-1, (-1, 4))
        return both[..., 3], both

    def of(
        self,
        eye: ArrayLike,
        time: float,
        children: Int64[Tensor, " gaussian"],
        time_only: Float[Tensor, "anchor child 4"] | None,
    ) -> Float[Tensor, "gaussian 3"]:
        """Colours of `children` (ascending slots of these anchors) at `time`, seen from `eye` [3].

        `time_only` is that of `changes`. Equal to the bit to `CanonicalAppearance.colors`, the bounded residual and the
        clip of `Scene.compose`. Raises `ValueError` for children out of order.
        """
        residual, part = self._residual, self._residual_part
        seeing, hidden, layers, degree = None, None, ([], []), 0
        if residual is not None and part is not None and residual.seeing is not None:
            seeing, hidden, degree = residual.seeing, part.seeing, residual.sh_degree
            encoded_time = residual.encoded(self._positions.new_tensor([time]))
            layers = seeing.layers(direction_width(degree), encoded_time)
        colors = self._positions.new_empty(len(children), 3)
        canonical = (self._part.normals, self._appearance.color_sh_degree, self._part.hidden, *_contiguous(self._layers))
        change = (degree, hidden, *_contiguous(layers), time_only, 0.0 if residual is None else residual.scale)
        view = (np.asarray(eye, dtype=np.float64).ravel(), constants.NEAR)
        kernel.kernel().paint(self._positions, *canonical, *change, *view, children, colors, kernel.thread_count())
        return colors


def _contiguous(layers: tuple[list[Tensor], list[Tensor]]) -> tuple[list[Tensor], list[Tensor]]:
    """Weights and biases as the kernel reads them."""
    weights, biases = ([tensor.detach().contiguous() for tensor in tensors] for tensors in layers)
    return weights, biases


