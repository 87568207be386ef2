"""The appearance of a prepared scene: scores of one time, colours of one view (Eq. 11 to 13)."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int64
from numpy.typing import ArrayLike
from torch import Tensor

from graings import constants, kernel
from graings.camera.frustum import Frustum
from graings.scene.appearance import ResidualPart, TemporalHead
from graings.scene.child_blocks import BLOCK, in_blocks
from graings.scene.children import Geometry
from graings.scene.encoding import direction_width, directions_from
from graings.scene.perceptron import GroupBias
from graings.scene.scene import Scene
from graings.scene.time_basis import TimeBasis, interpolated


class Candidates(NamedTuple):
    """The children that some time and some view may show, in the order of the scene."""

    slots: Int64[Tensor, " child"]  # among those of the kept anchors
    children: Int64[Tensor, " child"]  # flat slots (anchor * k + child) of the scene
    uids: Int64[Tensor, " child"]


class Rendered(NamedTuple):
    """The children that are rendered at one time, in the order of the scene."""

    rows: Int64[Tensor, " gaussian"]  # among the candidates
    slots: Int64[Tensor, " gaussian"]
    children: Int64[Tensor, " gaussian"]
    uids: Int64[Tensor, " gaussian"]
    opacities: Float[Tensor, " gaussian"]


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """The residual at one time: before its bound, except `colors`."""

    time_only: Float[Tensor, "anchor value"] | None  # for each slot Delta o, after Delta c where it has no direction
    biases: list[Tensor]  # of the head of Delta c that receives the direction; empty where it is not evaluated
    colors: Float[Tensor, "gaussian 3"] | None = None  # Delta c of the rendered children, by a basis


class BasisResidual:
    """(Delta c, Delta o) by a basis of functions of time, which describes offsets from `state`.

    With `exact_colors` the basis is used for Delta o only.
    """

    def __init__(self, basis: TimeBasis, state: Float[Tensor, "child 4"], *, exact_colors: bool) -> None:
        self._functions = basis.functions.to(state.dtype)
        self._weights = basis.in_blocks(len(state), state.dtype)
        self._state = in_blocks(state)
        self.exact_colors = exact_colors

    def at(self, time: float) -> Float[Tensor, "row 4"]:
        """Of all children, and of some rows that fill the last block."""
        found = self._state.new_empty(len(self._state) * BLOCK, 4)
        functions = interpolated(self._functions, time).contiguous()
        kernel.call("blend", *self._weights, self._state, functions, found, kernel.thread_count())
        return found

    def tensors(self) -> Iterable[Tensor]:
        """What is kept in memory."""
        return (*self._weights, self._state, self._functions)


class _Head:
    """A head of the residual without its part of the features, ready for the kernel."""

    def __init__(self, head: TemporalHead, part: GroupBias, others: int) -> None:
        self._head = head
        self.hidden = part.values
        self.weights = _contiguous(head.other_weights(others))

    def biases(self, encoded_time: Tensor) -> list[Tensor]:
        return _contiguous(self._head.biases(encoded_time))


class PreparedAppearance:
    """Opacities and colours of the children of `anchors` (indices) of `scene`, whose features are `features`."""

    def __init__(
        self, scene: Scene, anchors: Int64[Tensor, " anchor"], features: Float[Tensor, "anchor feature"]
    ) -> None:
        self._positions = scene.scaffold.anchors.index_select(0, anchors)
        self._slots = scene.scaffold.slots
        part = scene.appearance.color_part(features)
        layers = map(_contiguous, scene.appearance.color_layers(part))
        self._canonical = (part.normals, scene.appearance.color_sh_degree, part.hidden.values, *layers)
        self._residual = scene.residual if scene.temporal else None
        self._basis: BasisResidual | None = None
        self._part: ResidualPart | None = None
        self._time_only: _Head | None = None
        self._seeing: _Head | None = None
        if self._residual is not None:
            parts = self._part = self._residual.part(features)
            self._time_only = _Head(self._residual, parts.time_only, 0)
            if self._residual.seeing is not None and parts.seeing is not None:
                others = direction_width(self._residual.sh_degree)
                self._seeing = _Head(self._residual.seeing, parts.seeing, others)

    def with_basis(self, basis: BasisResidual) -> PreparedAppearance:
        """The same, with the residual of a time from `basis`."""
        other = copy.copy(self)
        other._basis = None if self._residual is None else basis
        return other

    def tensors(self) -> Iterable[Tensor]:
        """What is kept in memory."""
        heads = [head for head in (self._time_only, self._seeing) if head is not None]
        canonical = [part for part in self._canonical if isinstance(part, Tensor)]
        basis = () if self._basis is None else self._basis.tensors()
        return (self._positions, *canonical, *(head.hidden for head in heads), *basis)

    @property
    def residual_depends_on_view(self) -> bool:
        """Whether Delta c of Eq. 12 receives the viewing direction."""
        return self._seeing is not None

    def residual(
        self, time: float, eyes: Sequence[ArrayLike], slots: Int64[Tensor, " child"]
    ) -> Float[Tensor, "child 4"]:
        """(Delta c, Delta o) of Eq. 12 of the ascending `slots` of these anchors, the mean over `eyes`."""
        if self._residual is None or self._part is None or not len(slots):
            return self._positions.new_zeros(len(slots), 4)
        first, last = int(slots[0]) // self._slots, int(slots[-1]) // self._slots + 1
        directions = [directions_from(eye, self._positions[first:last]) for eye in eyes]
        raw = self._residual.of_directions(
            self._part.of_anchors(first, last), self._positions.new_tensor([time]), directions
        )
        return self._residual.bounded(raw.flatten(1, 2).index_select(1, slots - first * self._slots)).mean(0)

    def rendered(
        self, candidates: Candidates, opacities: Float[Tensor, "anchor child"], time: float
    ) -> tuple[Rendered, Changes | None]:
        """The candidates rendered at `time` in [0, 1] with canonical `opacities`, and the residual if any.

        Scores are those of `Scene.compose` to the bit.
        """
        count = len(candidates.slots)
        rows, slots, children, uids = candidates.slots.new_empty(4, count).unbind(0)
        found = Rendered(rows, slots, children, uids, opacities.new_empty(count))
        network: tuple[Any, ...] = (None, [], [], None)
        blended = changed = changes = None
        if self._residual is not None and self._time_only is not None:
            encoded_time = self._residual.encoded(self._positions.new_tensor([time]))
            seeing = None if self._basis is not None and not self._basis.exact_colors else self._seeing
            biases = [] if seeing is None else seeing.biases(encoded_time)
            if self._basis is None:
                time_biases = self._time_only.biases(encoded_time)
                changes = Changes(self._positions.new_empty(len(self._positions), len(time_biases[-1])), biases)
                network = (self._time_only.hidden, self._time_only.weights, time_biases, changes.time_only)
            else:
                blended, changed = self._basis.at(time), self._positions.new_empty(count, 3)
        bounds = (0.0 if self._residual is None else self._residual.scale, constants.ALPHA_MIN)
        inputs = (*candidates, opacities, *network, blended, *bounds)
        count = kernel.call("choose", *inputs, *found, changed, kernel.thread_count())
        if changed is not None:
            changes = Changes(None, biases, None if biases else changed[:count])
        return Rendered._make(part[:count] for part in found), changes

    def colors(
        self,
        eye: ArrayLike,
        children: Int64[Tensor, " gaussian"],
        changes: Changes | None,
        frustum: Frustum | None = None,
        geometry: Geometry | None = None,
    ) -> Float[Tensor, "gaussian 3"]:
        """Colours of `children` (ascending slots of these anchors) seen from `eye` [3] at the time of `changes`.

        Equal to the bit to those of `Scene.compose`. With a
        `frustum`, those whose `geometry` is outside it may be 0. Raises `ValueError` for children out of order.
        """
        network: tuple[Any, ...] = (0, None, [], [])
        time_only = blended = None
        if changes is not None and self._residual is not None:
            time_only, blended = changes.time_only, changes.colors
            if self._seeing is not None and blended is None:
                network = (self._residual.sh_degree, self._seeing.hidden, self._seeing.weights, changes.biases)
                time_only = None
        scale = 0.0 if self._residual is None else self._residual.scale
        colors = self._positions.new_empty(len(children), 3)
        view = (np.asarray(eye, dtype=np.float64).ravel(), constants.NEAR)
        where = (
            (None, None, None) if frustum is None or geometry is None else (frustum.packed(), geometry[0], geometry[2])
        )
        inputs = (self._positions, *self._canonical, *network, time_only, blended, scale, *view, children, *where)
        kernel.call("paint", *inputs, colors, kernel.thread_count())
        return colors


def _contiguous(tensors: list[Tensor]) -> list[Tensor]:
    """`tensors` as the kernel reads them."""
    return [tensor.detach().contiguous() for tensor in tensors]
