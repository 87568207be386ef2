"""Scene: what was learned. Composes the Gaussians of one instant as seen from one place (Eq. 3-13).

Opacity is evaluated first and only children that will be drawn go through the geometry networks: a score
at or below 1/255 leaves no trace in the picture, so this changes no pixel. Knows nothing of pixels, images
or losses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import ArrayLike
from torch import Tensor, nn

from graings import constants
from graings.config import SceneConfig
from graings.gaussians import Gaussians
from graings.scene.appearance import CanonicalAppearance, ResidualField
from graings.scene.canonical import INITIAL_SCALE, StaticMLP, canonical_attributes, identity_quaternion
from graings.scene.clip import clip
from graings.scene.deformation import Deformation, DeformationNetwork, SingleMLP, deformation_from
from graings.scene.scaffold import Scaffold

# Log standard deviations are kept in this range of normalised units: a factor 1e7 below and 100 above the
# scene. Outside, exp and its square would leave float32 (numerics, 2.8).
LOG_SCALE_RANGE = (-16.118095650958319, 4.605170185988092)


@dataclass(frozen=True, slots=True, eq=False)
class Composition:
    """The drawn children of one instant, with everything the losses and the growth statistics look at."""

    gaussians: Gaussians
    children: Int64[Tensor, " gaussian"]  # flat slot (anchor * k + child) of each Gaussian
    canonical_means: Float[Tensor, "gaussian 3"]  # x_can
    deformation: Deformation | None
    residual: Float[Tensor, "gaussian 4"] | None  # (Delta c, Delta o) of each Gaussian
    opacities: Float[Tensor, "anchor child"]  # score o(t) of every slot, drawn or not; no gradient


class Scene(nn.Module):
    """The model. `temporal` off (static warm-up, or a single instant) leaves the time modules unevaluated.

    `extent` is the half-size of the content in normalised units; positions enter the networks divided by it.
    """

    extent: Tensor

    def __init__(self, config: SceneConfig, scaffold: Scaffold, *, extent: float, initial_opacity: float) -> None:
        super().__init__()
        self.config = config
        self.scaffold = scaffold
        self.register_buffer("extent", torch.tensor(float(extent), dtype=scaffold.features.dtype))
        self.temporal = False
        self.appearance = CanonicalAppearance(config, initial_opacity)
        self.residual = ResidualField(config) if config.residual else None
        self.single: SingleMLP | None = None
        self.static: StaticMLP | None = None
        self.deformation: DeformationNetwork | None = None
        if config.single_mlp:
            self.single = SingleMLP(config)
        else:
            self.static = StaticMLP(config) if config.canonical else None
            self.deformation = DeformationNetwork(config) if config.deformation != "none" else None

    def gaussians(self, eye: ArrayLike, time: float) -> Gaussians:
        """What is drawn at `time` in [0, 1] from a camera centre `eye` [3] (normalised units)."""
        return self.compose(eye, time).gaussians

    def compose(self, eye: ArrayLike, time: float) -> Composition:
        """As `gaussians`, with the intermediate quantities of training."""
        scaffold, config = self.scaffold, self.config
        dtype = scaffold.features.dtype
        features = scaffold.features
        moment = torch.tensor([time], dtype=dtype)
        directions = self.directions(eye)

        scores = torch.tanh(
            self.appearance.opacity_logits(features, directions) + scaffold.opacity_offsets.unsqueeze(-1)
        )
        change: Tensor | None = None
        if self.temporal and self.residual is not None:
            source = features.detach() if config.residual_stop_gradient else features
            color_change, score_change = self.residual(source, moment)
            scores = scores + score_change
            change = torch.cat([color_change, score_change.unsqueeze(-1)], dim=-1).flatten(0, 1)

        children = (scores.detach().flatten() > constants.ALPHA_MIN).nonzero().squeeze(-1)
        colors = self.appearance.colors(features, directions).flatten(0, 1).index_select(0, children)
        drawn_change = None
        if change is not None:
            drawn_change = change.index_select(0, children)
            colors = clip(colors + drawn_change[:, :3], 0.0, 1.0, projected=config.projected_clip)

        canonical_means = scaffold.centres(children)
        quats, log_scales, deformation = self._geometry(children, canonical_means, time)
        means = canonical_means
        if deformation is not None:
            means, quats, log_scales = deformation.apply(
                canonical_means, quats, log_scales, projected_clip=config.projected_clip
            )
        gaussians = Gaussians(
            means=means,
            quats=quats,
            log_scales=clip(log_scales, *LOG_SCALE_RANGE, projected=config.projected_clip),
            opacities=scores.flatten().index_select(0, children),
            colors=colors,
            uids=scaffold.child_uids(children),
        )
        return Composition(gaussians, children, canonical_means, deformation, drawn_change, scores.detach())

    def directions(self, eye: ArrayLike) -> Float[Tensor, "anchor 3"]:
        """Unit vectors from the camera centre to every anchor (decision A21)."""
        anchors = self.scaffold.anchors
        towards = anchors - torch.as_tensor(np.asarray(eye, dtype=np.float64), dtype=anchors.dtype)
        return towards / towards.norm(dim=-1, keepdim=True).clamp_min(constants.NEAR)

    def deform(
        self, children: Int64[Tensor, " gaussian"], canonical_means: Float[Tensor, "gaussian 3"], time: float
    ) -> Deformation | None:
        """Offsets at `time` of drawn children (flat slots) with the canonical positions given, Eq. 7.

        None while the scene is static. The gradient is stopped, or not, as the configuration says.
        """
        if not self.temporal or (self.deformation is None and self.single is None):
            return None
        moment = torch.tensor([time], dtype=canonical_means.dtype)
        positions = (canonical_means.detach() if self.config.stop_gradient else canonical_means) / self.extent
        owners = children // self.scaffold.slots
        if self.single is not None:
            raw = self._single(self.single, children, positions, moment)[:, 7:]
        elif self.deformation is not None and self.config.deformation == "anchor":
            used, place = torch.unique(owners, return_inverse=True)
            anchors = self.scaffold.anchors.index_select(0, used) / self.extent
            raw = self.deformation(anchors, moment).index_select(0, place)
        else:
            assert self.deformation is not None
            raw = self.deformation(positions, moment)
        return deformation_from(raw, self.extent)

    def _single(self, single: SingleMLP, children: Tensor, positions: Tensor, moment: Tensor | None) -> Tensor:
        k = self.scaffold.slots
        offsets = self.scaffold.offsets.flatten(0, 1).index_select(0, children)
        raw: Tensor = single(self.scaffold.features, offsets, children // k, children % k, positions, moment)
        return raw

    def _canonical(self, children: Tensor) -> tuple[Tensor, Tensor]:
        """(quats, log_scales) of the drawn children before any deformation, Eq. 5."""
        scaffold = self.scaffold
        owners, slots = children // scaffold.slots, children % scaffold.slots
        base = scaffold.log_scales.index_select(0, owners)
        if self.static is None:
            return identity_quaternion(base).expand(len(children), 4), base + math.log(INITIAL_SCALE)
        offsets = scaffold.offsets.flatten(0, 1).index_select(0, children)
        quats, relative = self.static(scaffold.features, offsets, owners, slots)
        return quats, base + relative

    def _geometry(
        self, children: Tensor, canonical_means: Tensor, time: float
    ) -> tuple[Tensor, Tensor, Deformation | None]:
        """(canonical quats, canonical log_scales, deformation) of the drawn children."""
        if self.single is None:
            return *self._canonical(children), self.deform(children, canonical_means, time)
        positions = (canonical_means.detach() if self.config.stop_gradient else canonical_means) / self.extent
        moment = torch.tensor([time], dtype=positions.dtype) if self.temporal else None
        raw = self._single(self.single, children, positions, moment)
        quats, relative = canonical_attributes(raw[:, :7])
        base = self.scaffold.log_scales.index_select(0, children // self.scaffold.slots)
        return quats, base + relative, deformation_from(raw[:, 7:], self.extent) if self.temporal else None
