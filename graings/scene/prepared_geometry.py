"""The geometry of a prepared scene: of the children that some view shows, at one time after another."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from graings import kernel
from graings.scene.canonical import default_geometry
from graings.scene.child_blocks import ActiveUnits, in_blocks
from graings.scene.children import (
    LOG_SCALE_RANGE,
    MAX_LOG_SCALE_OFFSET,
    Children,
    Geometry,
    compose,
)
from graings.scene.deformation import DeformationNetwork
from graings.scene.scene import Scene
from graings.scene.time_basis import TimeBasis, interpolated


class PreparedGeometry(ABC):
    """Means, quaternions and log-scales of prepared children (Eq. 10)."""

    @abstractmethod
    def at(self, time: float, rows: Int64[Tensor, " gaussian"]) -> Geometry:
        """Those of the children `rows`, ascending indices of the prepared ones, at `time` in [0, 1]."""

    @abstractmethod
    def tensors(self) -> Iterable[Tensor]:
        """What is kept in memory."""

    @property
    @abstractmethod
    def products(self) -> float:
        """Numbers that each time multiplies by functions of time: what it costs."""


def prepared_geometry(scene: Scene, slots: Int64[Tensor, " child"]) -> PreparedGeometry:
    """The geometry of the children `slots` (flat, ascending) of `scene`."""
    moves = scene.temporal and (scene.deformation is not None or scene.single is not None)
    if not moves:
        return _Still(scene, slots)
    if scene.deformation is not None and scene.deformation.psi is not None and scene.config.deformation == "child":
        return _Factorized(scene, scene.deformation, slots)
    return _Evaluated(scene, slots)


class _Still(PreparedGeometry):
    """Without motion: the same at every time."""

    def __init__(self, scene: Scene, slots: Tensor) -> None:
        self._geometry = _evaluated(scene, slots, 0.0)

    def at(self, time: float, rows: Tensor) -> Geometry:
        means, quats, log_scales = (part.index_select(0, rows) for part in self._geometry)
        return means, quats, log_scales

    def tensors(self) -> Iterable[Tensor]:
        return self._geometry

    @property
    def products(self) -> float:
        return 0.0


class _Evaluated(PreparedGeometry):
    """Networks with little or nothing that all times share: evaluated for the rendered children, as `Scene` does."""

    def __init__(self, scene: Scene, slots: Tensor) -> None:
        self._scene, self._slots = scene, slots

    def at(self, time: float, rows: Tensor) -> Geometry:
        return _evaluated(self._scene, self._slots.index_select(0, rows), time)

    def tensors(self) -> Iterable[Tensor]:
        return (self._slots,)

    @property
    def products(self) -> float:
        return math.inf  # whole networks


def _evaluated(scene: Scene, slots: Tensor, time: float) -> Geometry:
    (geometry,), _ = scene.child_geometry(scene.gathered(slots), slots, [time])
    return geometry.means, geometry.quats, geometry.log_scales


class _Factorized(PreparedGeometry):
    """A factorized DeformNet: its hidden units are kept, and offsets are their product with W psi(t)."""

    def __init__(self, scene: Scene, deformation: DeformationNetwork, slots: Tensor) -> None:
        self._deformation, self._extent = deformation, float(scene.extent)
        children = scene.gathered(slots)
        static, means = scene.static, children.canonical_means
        canonical = default_geometry(means) if static is None else static(scene.scaffold.features, children)
        self._hidden = ActiveUnits.of(deformation.hidden_units(scene.network_positions(means)))
        self._rest = in_blocks(unmoved(canonical, children))

    def at(self, time: float, rows: Tensor) -> Geometry:
        weights, bias = self._deformation.output_layer(self._rest.new_tensor([[time]]))
        return move(self._hidden, self._rest, weights, bias, self._extent, rows)

    def tensors(self) -> Iterable[Tensor]:
        return (*self._hidden, self._rest)

    @property
    def products(self) -> float:
        return float(self._hidden.values.numel())


class BasisGeometry(PreparedGeometry):
    """By a basis of functions of time, which describes offsets from the states `means`, `quats`, `log_scales`."""

    def __init__(
        self,
        basis: TimeBasis,
        means: Float[Tensor, "child 3"],
        quats: Float[Tensor, "child 4"],
        log_scales: Float[Tensor, "child 3"],
    ) -> None:
        self._functions = basis.functions.to(means.dtype)
        self._weights = basis.in_blocks(len(means), means.dtype)
        self._rest = in_blocks(torch.cat([means, quats, log_scales], dim=1))
        self._bias = means.new_zeros(10)

    def at(self, time: float, rows: Tensor) -> Geometry:
        functions = interpolated(self._functions, time).T
        return move(self._weights, self._rest, functions, self._bias, 1.0, rows, largest_change=math.inf)

    def tensors(self) -> Iterable[Tensor]:
        return (*self._weights, self._rest, self._functions)

    @property
    def products(self) -> float:
        return float(self._weights.values.numel())


def unmoved(canonical: Float[Tensor, "child 7"], children: Children) -> Float[Tensor, "child 10"]:
    """Mean, unit quaternion and log-scale, not yet clipped, of children without an offset in time."""
    (geometry,) = compose(canonical, children, None, 1.0, projected_clip=False)
    return torch.cat([geometry.means, geometry.quats, children.anchor_log_scales + canonical[:, 4:]], dim=1)


def move(
    hidden: ActiveUnits,
    rest: Float[Tensor, "block 10 16"],
    weights: Float[Tensor, "10 width"],
    bias: Float[Tensor, " 10"],
    extent: float,
    rows: Int64[Tensor, " gaussian"],
    largest_change: float = MAX_LOG_SCALE_OFFSET,
) -> Geometry:
    """Geometry (Eq. 10) of the children `rows` with the offsets `weights` @ hidden units + `bias`.

    `rest` is `unmoved` `in_blocks`. Equal to the bit to the last layer of `perceptron` followed by `compose`. Raises
    `ValueError` for a row out of range.
    """
    geometry = rest.new_empty(len(rows), 3), rest.new_empty(len(rows), 4), rest.new_empty(len(rows), 3)
    bounds = (extent, largest_change, *LOG_SCALE_RANGE)
    kernel.call("move", *hidden, rest, weights.contiguous(), bias, *bounds, rows, *geometry, kernel.thread_count())
    return geometry
