"""Scene: the trained model. Composes the Gaussians of one instant for one camera position (Eq. 3-5, 7 and 10-13).

Opacity scores are evaluated first, because the rasterizer skips scores of at most 1/255: colours and residuals are
evaluated only for anchors with a child whose score may exceed it, the geometry networks only for children whose score
does. The rendered image is the same as with all children.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from numpy.typing import ArrayLike
from torch import Tensor, nn

from graings import constants
from graings.camera.sampling_rate import SamplingRate
from graings.config import SceneConfig
from graings.gaussians import Gaussians
from graings.random import torch_stream
from graings.scene.activations import tanh
from graings.scene.appearance import CanonicalAppearance, ResidualField
from graings.scene.canonical import INITIAL_SCALE, StaticMLP, default_geometry
from graings.scene.child_colors import child_colors
from graings.scene.children import ChildGeometry, Children, compose, gather
from graings.scene.deformation import Deformation, DeformationNetwork, SingleMLP
from graings.scene.encoding import directions_from
from graings.scene.scaffold import Scaffold


@dataclass(frozen=True, slots=True, eq=False)
class Composed:
    """The Gaussians of one view, and what drawing them needs beside."""

    gaussians: Gaussians
    children: Int64[Tensor, " gaussian"]  # flat slot (anchor * k + child) of each Gaussian
    blur: float  # variance of the low-pass filter used in training, px^2 at the sampling rate `sampling`
    sampling: SamplingRate | None  # None: the filter has this width in the pixels of every image


@dataclass(frozen=True, slots=True, eq=False)
class Composition(Composed):
    """The Gaussians of one view, with everything the losses and the growth statistics read.

    They include children that only another view, composed together with this one, renders.
    """

    canonical_means: Float[Tensor, "gaussian 3"]  # x_can
    position_offsets: Float[Tensor, "gaussian 3"] | None  # Delta x of Eq. 10, normalised units; None: static
    deformation: Deformation | None  # at the times of all views composed together, in their order
    residual: Float[Tensor, "gaussian 4"] | None  # (Delta c, Delta o) of each Gaussian
    opacities: Float[Tensor, "anchor child"]  # score of every slot, no gradient: o(t) of candidates, else o_can


class Scene(nn.Module):
    """The model: anchors and networks.

    Without `temporal` (static warm-up, or a capture of one instant) no time-conditioned module is evaluated.
    `extent` is the half-size of the content in normalised units; positions enter the networks divided by it. `sampling`
    is the sampling rate of the training views: the low-pass filter is part of the trained model and has the same size
    on the scene in every image. `seed` seeds the initial weights of the networks. Raises `ValueError` for anchors that
    have other features or children than `config` says.
    """

    extent: Tensor

    def __init__(
        self,
        config: SceneConfig,
        scaffold: Scaffold,
        *,
        extent: float,
        sampling: SamplingRate,
        initial_opacity: float,
        seed: int = 0,
    ) -> None:
        super().__init__()
        shape = (scaffold.features.shape[1], scaffold.slots)
        if shape != (config.feature_dim, config.children):
            wanted = f"features of {config.feature_dim} numbers and {config.children} children"
            raise ValueError(f"anchors must have {wanted}, got {shape[0]} and {shape[1]}")
        self.config = config
        self.scaffold = scaffold
        self.register_buffer("extent", torch.tensor(float(extent), dtype=scaffold.features.dtype))
        self.sampling = sampling
        self.temporal = False
        # Of the networks' log-scales: that of each anchor, or one for all.
        self.log_unit = None if config.relative_scales or not config.canonical else math.log(float(self.extent))
        initial_log_scale = math.log(INITIAL_SCALE)
        if self.log_unit is not None:
            initial_log_scale += float(scaffold.log_scales.detach().median()) - self.log_unit
        self.residual: ResidualField | None = None
        self.single: SingleMLP | None = None
        self.static: StaticMLP | None = None
        self.deformation: DeformationNetwork | None = None
        # The initial weights of a network do not depend on which others exist, so ablations differ in one part only.
        with torch_stream(seed, "init.appearance"):
            self.appearance = CanonicalAppearance(config, initial_opacity)
        if config.residual:
            with torch_stream(seed, "init.residual"):
                self.residual = ResidualField(config)
        if config.single_mlp:
            with torch_stream(seed, "init.single"):
                self.single = SingleMLP(config, initial_log_scale)
        elif config.canonical:
            with torch_stream(seed, "init.static"):
                self.static = StaticMLP(config, initial_log_scale)
        if not config.single_mlp and config.deformation != "none":
            with torch_stream(seed, "init.deformation"):
                self.deformation = DeformationNetwork(config)

    def gaussians(self, eye: ArrayLike, time: float) -> Gaussians:
        """The Gaussians at `time` in [0, 1] for the camera centre `eye` [3] (normalised units)."""
        return self.compose(eye, time).gaussians

    def compose(self, eye: ArrayLike, time: float) -> Composition:
        """As `gaussians`, with the intermediate quantities that training needs."""
        return self.compose_together([(eye, time)])[0]

    def compose_together(self, views: Sequence[tuple[ArrayLike, float]]) -> list[Composition]:
        """As `compose` for several views (eye, time); each contains the children that any of the views renders.

        A child that a view would skip on its own has a score of at most 1/255 there, so no image changes. Everything
        that does not depend on the view, which is most of the networks' work, is computed once.
        """
        scaffold, config, slots = self.scaffold, self.config, self.scaffold.slots
        directions = [self.directions(eye) for eye, _ in views]
        times = [time for _, time in views]

        residual_field = self.residual if self.temporal else None
        canonical_opacities = self._canonical_opacities(directions)
        candidates = _candidate_anchors(canonical_opacities, 0.0 if residual_field is None else residual_field.scale)
        features = scaffold.features.index_select(0, candidates)
        opacities = [score.index_select(0, candidates) for score in canonical_opacities]
        directions = [direction.index_select(0, candidates) for direction in directions]
        residuals: list[Tensor | None] = [None] * len(views)
        if residual_field is not None:
            residual_part = residual_field.part(features)
            residuals = [
                residual_field(residual_part, torch.tensor([time], dtype=features.dtype), direction)
                for time, direction in zip(times, directions, strict=True)
            ]
            opacities = [
                score if residual is None else score + residual_field.bounded(residual[..., 3])
                for score, residual in zip(opacities, residuals, strict=True)
            ]
        highest = torch.stack([score.detach() for score in opacities]).amax(0).flatten()
        rendered = (highest > constants.ALPHA_MIN).nonzero().squeeze(-1)  # among the slots of the candidates
        slot_indices = candidates[rendered // slots] * slots + rendered % slots

        color_part = self.appearance.color_part(features)
        children = self.gathered(slot_indices)
        uids = scaffold.child_uids(slot_indices)
        compositions = []
        geometries, deformation = self.child_geometry(children, slot_indices, times)
        per_view = zip(canonical_opacities, opacities, residuals, directions, geometries, strict=True)
        for canonical_opacity, opacity, residual, direction, geometry in per_view:
            shown = child_colors(
                self.appearance.color_logits(color_part, direction),
                None if residual is None else residual.flatten(0, 1),
                rendered,
                config.residual_scale,
                projected_clip=config.projected_clip,
            )
            gaussians = Gaussians(
                means=geometry.means,
                quats=geometry.quats,
                log_scales=geometry.log_scales,
                opacities=opacity.flatten().index_select(0, rendered),
                colors=shown.colors,
                uids=uids,
            )
            compositions.append(
                Composition(
                    gaussians=gaussians,
                    children=slot_indices,
                    canonical_means=children.canonical_means,
                    position_offsets=geometry.position_offsets,
                    deformation=deformation,
                    residual=shown.residual,
                    opacities=canonical_opacity.detach().index_copy(0, candidates, opacity.detach()),
                    blur=config.blur,
                    sampling=self.sampling,
                )
            )
        return compositions

    def _canonical_opacities(self, directions: Sequence[Tensor]) -> list[Tensor]:
        """o_can [A, k] of every slot for each view, Eq. 11."""
        offsets = self.scaffold.slot_opacity_offsets
        scores: list[Tensor] = []
        for direction in directions:
            if not scores or self.config.opacity_view:
                scores.append(tanh(self.appearance.opacity_logits(self.scaffold.features, direction) + offsets))
            else:
                scores.append(scores[0])
        return scores

    def directions(self, eye: ArrayLike) -> Float[Tensor, "anchor 3"]:
        """Viewing direction v of Eq. 11: unit vectors from the camera centre `eye` [3] to every anchor."""
        return directions_from(eye, self.scaffold.anchors)

    def gathered(self, slots: Int64[Tensor, " gaussian"]) -> Children:
        """Inputs of the geometry networks for the children at the given flat slots, ascending (Eq. 4)."""
        children = gather(self.scaffold, slots)
        if self.log_unit is None:
            return children
        return replace(children, anchor_log_scales=torch.full_like(children.canonical_means, self.log_unit))

    def deform(
        self, children: Int64[Tensor, " gaussian"], canonical_means: Float[Tensor, "gaussian 3"], time: float
    ) -> Deformation | None:
        """Offsets of rendered children (flat slots, ascending) with the given canonical positions at one time, Eq. 7.

        None while the scene is static. The stop-gradient of Eq. 7 is applied as configured.
        """
        if not self.temporal or (self.deformation is None and self.single is None):
            return None
        if self.single is not None:
            outputs = self._single_mlp(self.single, self.gathered(children), canonical_means, time)[:, None, 7:]
        else:
            outputs = self._predicted_deformation(children, canonical_means, [time])
        return Deformation(outputs, float(self.extent))

    def child_geometry(
        self, children: Children, slot_indices: Tensor, times: Sequence[float]
    ) -> tuple[list[ChildGeometry], Deformation | None]:
        """The rendered children at each time, and their offsets; None while the scene is static."""
        means, extent = children.canonical_means, float(self.extent)
        moves = self.temporal and (self.deformation is not None or self.single is not None)
        if self.single is not None and moves:
            # Its canonical geometry may depend on time.
            at_times = [self._single_mlp(self.single, children, means, time) for time in times]
            result = [self._composed(one[:, :7], children, one[:, None, 7:])[0] for one in at_times]
            return result, Deformation(torch.stack([one[:, 7:] for one in at_times], dim=1), extent)
        if self.single is not None:
            canonical = self._single_mlp(self.single, children, means, None)[:, :7]
        elif self.static is not None:
            canonical = self.static(self.scaffold.features, children)
        else:
            canonical = default_geometry(means)
        if not moves:
            return self._composed(canonical, children, None) * len(times), None
        outputs = self._predicted_deformation(slot_indices, means, times)
        return self._composed(canonical, children, outputs), Deformation(outputs, extent)

    def _composed(self, canonical: Tensor, children: Children, deformation: Tensor | None) -> list[ChildGeometry]:
        extent, projected = float(self.extent), self.config.projected_clip
        return compose(canonical, children, deformation, extent, projected_clip=projected)

    def _predicted_deformation(
        self, slot_indices: Tensor, canonical_means: Tensor, times: Sequence[float]
    ) -> Float[Tensor, "gaussian time 10"]:
        """Output of DeformNet; with anchor deformation all children of an anchor share it."""
        assert self.deformation is not None
        time_rows = torch.tensor(times, dtype=canonical_means.dtype).unsqueeze(-1)
        if self.config.deformation == "anchor":
            anchors, owners = torch.unique(slot_indices // self.scaffold.slots, return_inverse=True)
            positions = self.network_positions(self.scaffold.anchors.index_select(0, anchors))
            shared: Tensor = self.deformation(positions, time_rows)
            return shared.index_select(0, owners)
        outputs: Tensor = self.deformation(self.network_positions(canonical_means), time_rows)
        return outputs

    def _single_mlp(self, single: SingleMLP, children: Children, canonical_means: Tensor, time: float | None) -> Tensor:
        time_row = None if time is None else torch.tensor([time], dtype=canonical_means.dtype)
        output: Tensor = single(self.scaffold.features, children, self.network_positions(canonical_means), time_row)
        return output

    def network_positions(self, canonical_means: Tensor) -> Tensor:
        """sg(x_can) of Eq. 7 in units of the extent; without the stop-gradient where so configured."""
        return (canonical_means.detach() if self.config.stop_gradient else canonical_means) / self.extent


def _candidate_anchors(
    canonical_opacities: Sequence[Float[Tensor, "anchor child"]], max_residual: float
) -> Int64[Tensor, " candidate"]:
    """Anchors with a child that may be rendered in one of the views: |Delta o| is at most `max_residual`."""
    highest = torch.stack([score.detach().amax(-1) for score in canonical_opacities]).amax(0)
    return (highest + max_residual > constants.ALPHA_MIN).nonzero().squeeze(-1)
