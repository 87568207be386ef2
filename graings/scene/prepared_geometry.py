"""The geometry of a prepared scene: of the children that some view shows, at one time after another."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor
from torch.nn import functional

from graings import kernel
from graings.scene.canonical import default_geometry
from graings.scene.children import (
    LOG_SCALE_RANGE,
    MAX_LOG_SCALE_OFFSET,
    Children,
    Geometry,
    compose,
)
from graings.scene.deformation import DeformationNetwork
from graings.scene.scene import Scene

# Children side by side in one block of the kernel's arrays.
BLOCK = 16


class PreparedGeometry(ABC):
    """Means, quaternions and log-scales of prepared children (Eq. 10)."""

    @abstractmethod
    def at(self, time: float, rows: Int64[Tensor, " gaussian"]) -> Geometry:
        """Those of the children `rows`, ascending indices of the prepared ones, at `time` in [0, 1]."""

    @abstractmethod
    def tensors(self) -> Iterable[Tensor]:
        """What is kept in memory."""


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


class _Evaluated(PreparedGeometry):
    """Networks with little or nothing that all times share: evaluated for the rendered children, as `Scene` does."""

    def __init__(self, scene: Scene, slots: Tensor) -> None:
        self._scene, self._slots = scene, slots

    def at(self, time: float, rows: Tensor) -> Geometry:
        return _evaluated(self._scene, self._slots.index_select(0, rows), time)

    def tensors(self) -> Iterable[Tensor]:
        return (self._slots,)


def _evaluated(scene: Scene, slots: Tensor, time: float) -> Geometry:
    children = scene.gathered(slots)
    ((canonical, raw),) = scene.predicted_geometry(children, slots, [time])
    return compose(canonical, children, raw, float(scene.extent), projected_clip=scene.config.projected_clip)


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


def unmoved(canonical: Float[Tensor, "child 7"], children: Children) -> Float[Tensor, "child 10"]:
    """Mean, unit quaternion and log-scale, not yet clipped, of children without an offset in time."""
    means, quats, _ = compose(canonical, children, None, 1.0, projected_clip=False)
    return torch.cat([means, quats, children.anchor_log_scales + canonical[:, 4:]], dim=1)


def in_blocks(rows: Float[Tensor, "child width"]) -> Float[Tensor, "block width 16"]:
    """`rows` in blocks of `BLOCK` children, transposed; the last one is filled with zeros."""
    padded = functional.pad(rows, (0, 0, 0, -len(rows) % BLOCK))
    return padded.view(-1, BLOCK, rows.shape[1]).transpose(1, 2).contiguous()


class ActiveUnits(NamedTuple):
    """Hidden units in blocks of `BLOCK` children, without those that ReLU makes zero in a whole block.

    A third is left out, because children near each other share theirs; it adds exactly nothing to a sum.
    """

    values: Float[Tensor, "active 16"]
    begin: Int64[Tensor, " _"]  # of each block in `values`, and the end of the last
    units: Int32[Tensor, " active"]  # which hidden unit each row of `values` is

    @staticmethod
    def of(hidden: Float[Tensor, "child width"]) -> ActiveUnits:
        """Those of `hidden`."""
        blocks = in_blocks(hidden)
        active = (blocks != 0).any(2)
        begin = functional.pad(active.sum(1).cumsum(0), (1, 0))
        return ActiveUnits(blocks[active], begin, active.nonzero()[:, 1].int())


def move(
    hidden: ActiveUnits,
    rest: Float[Tensor, "block 10 16"],
    weights: Float[Tensor, "10 width"],
    bias: Float[Tensor, " 10"],
    extent: float,
    rows: Int64[Tensor, " gaussian"],
) -> Geometry:
    """Geometry (Eq. 10) of the children `rows` with the offsets `weights` @ hidden units + `bias`.

    `rest` is `unmoved` `in_blocks`. Equal to the bit to the last layer of `perceptron` followed by `compose`. Raises
    `ValueError` for a row out of range.
    """
    geometry = rest.new_empty(len(rows), 3), rest.new_empty(len(rows), 4), rest.new_empty(len(rows), 3)
    bounds = (extent, MAX_LOG_SCALE_OFFSET, *LOG_SCALE_RANGE)
    kernel.kernel().move(*hidden, rest, weights.contiguous(), bias, *bounds, rows, *geometry, kernel.thread_count())
    return geometry
