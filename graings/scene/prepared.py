"""PreparedScene: a trained scene with everything evaluated that depends on neither time nor view.

A `Scene` evaluates its networks anew for every composition, which training needs. A prepared scene has evaluated them
once, without gradients, and composes the same Gaussians to the bit: it calls the same functions, or kernels whose sums
have the same order (tests/scene/test_prepared.py).

- Once: canonical geometry, the hidden units of a factorized DeformNet, canonical opacities, and the features' part of
  the heads of colour and residual.
- For each time: opacities, which children are rendered, and their geometry. The last times are kept.
- For each view: colours.

Children that no time and no view can show are left out. A score is o = o_can + Delta o with |Delta o| <= eta, and
rounding is monotone: where o_can + eta, rounded, is at most 1/255, so is every o. With `opacity_view` the bound of
o_can over all directions takes its place, enlarged by a bound of the rounding of both.
"""

from __future__ import annotations

import copy
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float, Int64
from numpy.typing import ArrayLike
from torch import Tensor

from graings import constants
from graings.camera.frustum import Frustum
from graings.gaussians import Gaussians
from graings.scene.activations import tanh
from graings.scene.children import Geometry
from graings.scene.prepared_appearance import BasisResidual, Candidates, Changes, PreparedAppearance, Rendered
from graings.scene.prepared_geometry import PreparedGeometry, prepared_geometry
from graings.scene.scene import Composed, Scene

# Times of which geometry and opacities are kept: players show one time from many views, or a few times again.
KEPT_TIMES: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class _Instant:
    """What all views of one time share."""

    rendered: Rendered
    geometry: Geometry
    changes: Changes | None


class PreparedScene:
    """`scene` as it is now, for many views of it; valid until a parameter of `scene` changes.

    May be used from several threads. `kept_times` is how many of the last times are kept; 0: none.
    """

    @torch.inference_mode()
    def __init__(self, scene: Scene, *, kept_times: int = KEPT_TIMES) -> None:
        self.scene = scene
        scaffold, slots = scene.scaffold, scene.scaffold.slots
        shown = possible_children(scene)
        self._anchors = shown.any(1).nonzero().squeeze(-1)
        self._features = scaffold.features.index_select(0, self._anchors)
        self._opacity_offsets = scaffold.slot_opacity_offsets.index_select(0, self._anchors)
        self._opacities = (
            None
            if scene.config.opacity_view
            else self._canonical_opacities(self._features.new_empty(len(self._features), 3))
        )
        kept = shown.index_select(0, self._anchors).flatten().nonzero().squeeze(-1)
        children = self._anchors[kept // slots] * slots + kept % slots
        self._candidates = Candidates(kept, children, scaffold.child_uids(children))
        self._geometry = prepared_geometry(scene, children)
        self._appearance = PreparedAppearance(scene, self._anchors, self._features)
        self._kept_times = kept_times
        self._instants: OrderedDict[float, _Instant] = OrderedDict()
        self._guard = threading.Lock()

    def with_basis(self, geometry: PreparedGeometry, residual: BasisResidual) -> PreparedScene:
        """The same scene with another way of evaluating time; what does not depend on time is shared.

        Exact geometry stays where that of the basis does not cost less, as that of quick motions may not.
        """
        other = copy.copy(self)
        if geometry.products < self._geometry.products:
            other._geometry = geometry
        other._appearance = self._appearance.with_basis(residual)
        other._instants, other._guard = OrderedDict(), threading.Lock()
        return other

    @property
    def children(self) -> int:
        """Number of children that some time and view may show."""
        return len(self._candidates.children)

    @property
    def bytes(self) -> int:
        """Memory of what is kept beside the scene, with as many times as may be kept."""
        own = (self._anchors, self._features, self._opacity_offsets, *self._candidates)
        tensors = (*own, *self._geometry.tensors(), *self._appearance.tensors())
        # Of a time: four indices, score and geometry of each child, and the residual of each slot.
        slots = len(self._anchors) * self.scene.scaffold.slots
        instant = self.children * (4 * 8 + 11 * 4) + slots * 4 * 4
        return sum(t.numel() * t.element_size() for t in tensors) + self._kept_times * instant

    @property
    def slots(self) -> Int64[Tensor, " child"]:
        """Flat slots (anchor * k + child) of these children in the scene, ascending."""
        return self._candidates.children

    @property
    def products(self) -> float:
        """What the geometry of each time costs: see `PreparedGeometry`."""
        return self._geometry.products

    @property
    def uids(self) -> Int64[Tensor, " child"]:
        """Persistent numbers of these children."""
        return self._candidates.uids

    @torch.inference_mode()
    def geometry(self, time: float, rows: Int64[Tensor, " row"]) -> Geometry:
        """Means, quaternions and log-scales of the children `rows` (ascending) at `time`, shown there or not."""
        return self._geometry.at(time, rows)

    @torch.inference_mode()
    def residual(self, time: float, eyes: Sequence[ArrayLike], rows: Int64[Tensor, " row"]) -> Float[Tensor, "row 4"]:
        """(Delta c, Delta o) of Eq. 12 of the children `rows` (ascending) at `time`, the mean over `eyes`; else 0."""
        return self._appearance.residual(time, eyes, self._candidates.slots.index_select(0, rows))

    @property
    def residual_depends_on_view(self) -> bool:
        """Whether Delta c of `residual` depends on the eye."""
        return self._appearance.residual_depends_on_view

    @torch.inference_mode()
    def canonical_opacities(self, eye: ArrayLike) -> Float[Tensor, " child"]:
        """o_can of Eq. 11 of all these children; `eye` counts with `opacity_view` only."""
        return self._opacities_from(eye).flatten().index_select(0, self._candidates.slots)

    @torch.inference_mode()
    def canonical_colors(self, eye: ArrayLike) -> Float[Tensor, "child 3"]:
        """c_can of Eq. 11 of all these children."""
        return self._appearance.colors(eye, self._candidates.slots, None)

    @torch.inference_mode()
    def compose(self, eye: ArrayLike, time: float, frustum: Frustum | None = None) -> Composed:
        """The Gaussians at `time` in [0, 1] for the camera centre `eye` [3] (normalised units).

        With a `frustum`, colours of those that its camera cannot see may be missing: they are 0.
        """
        instant = self._instant(eye, time)
        rendered, (means, quats, log_scales) = instant.rendered, instant.geometry
        return Composed(
            gaussians=Gaussians(
                means=means,
                quats=quats,
                log_scales=log_scales,
                opacities=rendered.opacities,
                colors=self._appearance.colors(eye, rendered.slots, instant.changes, frustum, instant.geometry),
                uids=rendered.uids,
            ),
            children=rendered.children,
            blur=self.scene.config.blur,
            sampling=self.scene.sampling,
        )

    def _instant(self, eye: ArrayLike, time: float) -> _Instant:
        if self._opacities is None:  # opacities, and with them the choice of children, depend on the view
            return self._instant_with(self._opacities_from(eye), time)
        with self._guard:
            known = self._instants.get(time)
            if known is not None:
                self._instants.move_to_end(time)
                return known
        instant = self._instant_with(self._opacities, time)
        with self._guard:
            self._instants[time] = instant
            while len(self._instants) > self._kept_times:
                self._instants.popitem(last=False)
        return instant

    def _instant_with(self, opacities: Float[Tensor, "anchor child"], time: float) -> _Instant:
        """The instant with these canonical `opacities`."""
        rendered, changes = self._appearance.rendered(self._candidates, opacities, time)
        return _Instant(rendered, self._geometry.at(time, rendered.rows), changes)

    def _opacities_from(self, eye: ArrayLike) -> Float[Tensor, "anchor child"]:
        if self._opacities is not None:
            return self._opacities
        return self._canonical_opacities(self.scene.directions(eye).index_select(0, self._anchors))

    def _canonical_opacities(self, directions: Float[Tensor, "anchor 3"]) -> Float[Tensor, "anchor child"]:
        """o_can (Eq. 11) of every slot of the kept anchors; `directions` count with `opacity_view` only."""
        return tanh(self.scene.appearance.opacity_logits(self._features, directions) + self._opacity_offsets)


def possible_children(scene: Scene) -> Bool[Tensor, "anchor child"]:
    """Which child slots some time and some view may show; see the module for the proof."""
    scaffold, residual = scene.scaffold, scene.residual if scene.temporal else None
    with torch.no_grad():
        if scene.config.opacity_view:
            logits = scene.appearance.highest_opacity_logits(scaffold.features)
            logits = logits + scene.appearance.opacity_rounding(scaffold.features)
        else:
            logits = scene.appearance.opacity_logits(scaffold.features, scaffold.anchors)  # which has no direction
        highest = tanh(logits + scaffold.slot_opacity_offsets)
        return highest + (0.0 if residual is None else residual.scale) > constants.ALPHA_MIN
