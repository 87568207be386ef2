"""The colours of a prepared scene: what is left of the heads of colour and residual for one view (Eq. 11 to 13)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int64
from numpy.typing import ArrayLike
from torch import Tensor

from graings import constants, kernel
from graings.scene.encoding import direction_width
from graings.scene.scene import Scene

Layers = tuple[list[Tensor], list[Tensor]]  # weights and biases


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """The residual at one time, before its bound."""

    values: Float[Tensor, "anchor child value"]  # Delta o last; before it Delta c, where that has no direction
    layers: Layers  # of the head of Delta c that receives the direction; empty where there is none


class PreparedColors:
    """Colours of the children of `anchors` (indices) of `scene`, whose features are `features`."""

    def __init__(
        self, scene: Scene, anchors: Int64[Tensor, " anchor"], features: Float[Tensor, "anchor feature"]
    ) -> None:
        self._residual = scene.residual if scene.temporal else None
        self._positions = scene.scaffold.anchors.index_select(0, anchors)
        part = scene.appearance.color_part(features)
        layers = _contiguous(scene.appearance.color_layers(part))
        self._canonical = (part.normals, scene.appearance.color_sh_degree, part.hidden.values, *layers)
        self._residual_part = None if self._residual is None else self._residual.part(features)

    def changes(self, time: float) -> Changes | None:
        """The residual of every slot at `time` in [0, 1]; None where there is none."""
        residual, part = self._residual, self._residual_part
        if residual is None or part is None:
            return None
        encoded_time = residual.encoded(self._positions.new_tensor([time]))
        raw = residual.predict(part.time_only, encoded_time)
        if residual.seeing is None:
            return Changes(raw.unflatten(-1, (-1, 4)), ([], []))
        layers = residual.seeing.layers(direction_width(residual.sh_degree), encoded_time)
        return Changes(raw.unsqueeze(-1), _contiguous(layers))

    def of(
        self, eye: ArrayLike, children: Int64[Tensor, " gaussian"], changes: Changes | None
    ) -> Float[Tensor, "gaussian 3"]:
        """Colours of `children` (ascending slots of these anchors) seen from `eye` [3] at the time of `changes`.

        Equal to the bit to `CanonicalAppearance.colors`, the bounded residual and the clip of `Scene.compose`. Raises
        `ValueError` for children out of order.
        """
        change: tuple[Any, ...] = (0, None, [], [], None, 0.0)
        residual, part = self._residual, self._residual_part
        if changes is not None and residual is not None and part is not None:
            if part.seeing is None:
                change = (0, None, [], [], changes.values, residual.scale)
            else:
                change = (residual.sh_degree, part.seeing.values, *changes.layers, None, residual.scale)
        colors = self._positions.new_empty(len(children), 3)
        view = (np.asarray(eye, dtype=np.float64).ravel(), constants.NEAR)
        kernel.kernel().paint(
            self._positions, *self._canonical, *change, *view, children, colors, kernel.thread_count()
        )
        return colors


def _contiguous(layers: Layers) -> Layers:
    """Weights and biases as the kernel reads them."""
    weights, biases = ([tensor.detach().contiguous() for tensor in tensors] for tensors in layers)
    return weights, biases


