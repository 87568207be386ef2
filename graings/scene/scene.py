"""Scene: what was learned. Composes the Gaussians of one instant as seen from one place (Eq. 3-13).

Opacity is evaluated first and only children that will be drawn go through the geometry networks: a score
at or below 1/255 leaves no trace in the picture, so this changes no pixel. Knows nothing of pixels, images
or losses.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from graings.scene.canonical import StaticMLP, unlearned
from graings.scene.children import Children, compose, gather
from graings.scene.clip import clip
from graings.scene.deformation import Deformation, DeformationNetwork, SingleMLP, deformation_from
from graings.scene.saturate import tanh
from graings.scene.scaffold import Scaffold
from graings.seeds import global_stream


@dataclass(frozen=True, slots=True, eq=False)
class Composition:
    """What is drawn at one instant, with everything the losses and the growth statistics look at.

    Children that another view composed together with this one draws are among them.
    """

    gaussians: Gaussians
    children: Int64[Tensor, " gaussian"]  # flat slot (anchor * k + child) of each Gaussian
    canonical_means: Float[Tensor, "gaussian 3"]  # x_can
    deformation: Deformation | None
    residual: Float[Tensor, "gaussian 4"] | None  # (Delta c, Delta o) of each Gaussian
    opacities: Float[Tensor, "anchor child"]  # score o(t) of every slot, drawn or not; no gradient


class Scene(nn.Module):
    """The model. `temporal` off (static warm-up, or a single instant) leaves the time modules unevaluated.

    `extent` is the half-size of the content in normalised units; positions enter the networks divided by it. `seed` is
    that of the networks' first weights.
    """

    extent: Tensor

    def __init__(
        self, config: SceneConfig, scaffold: Scaffold, *, extent: float, initial_opacity: float, seed: int = 0
    ) -> None:
        super().__init__()
        self.config = config
        self.scaffold = scaffold
        self.register_buffer("extent", torch.tensor(float(extent), dtype=scaffold.features.dtype))
        self.temporal = False
        self.residual: ResidualField | None = None
        self.single: SingleMLP | None = None
        self.static: StaticMLP | None = None
        self.deformation: DeformationNetwork | None = None
        # Each network begins with the same weights whichever others there are: ablations differ by their part alone.
        with global_stream(seed, "init.appearance"):
            self.appearance = CanonicalAppearance(config, initial_opacity)
        if config.residual:
            with global_stream(seed, "init.residual"):
                self.residual = ResidualField(config)
        if config.single_mlp:
            with global_stream(seed, "init.single"):
                self.single = SingleMLP(config)
        elif config.canonical:
            with global_stream(seed, "init.static"):
                self.static = StaticMLP(config)
        if not config.single_mlp and config.deformation != "none":
            with global_stream(seed, "init.deformation"):
                self.deformation = DeformationNetwork(config)

    def gaussians(self, eye: ArrayLike, time: float) -> Gaussians:
        """What is drawn at `time` in [0, 1] from a camera centre `eye` [3] (normalised units)."""
        return self.compose(eye, time).gaussians

    def compose(self, eye: ArrayLike, time: float) -> Composition:
        """As `gaussians`, with the intermediate quantities of training."""
        return self.compose_together([(eye, time)])[0]

    def compose_together(self, views: Sequence[tuple[ArrayLike, float]]) -> list[Composition]:
        """As `compose` for several views (eye, time), which share their children: those drawn in any of them.

        A child that one view would have left out has no opacity to speak of there, so no picture changes; and what does
        not depend on the view, most of the networks' work, is done once.
        """
        scaffold, config = self.scaffold, self.config
        features = scaffold.features
        moments = [torch.tensor([time], dtype=features.dtype) for _, time in views]
        directions = [self.directions(eye) for eye, _ in views]

        residual = self.residual if self.temporal else None
        scores, changes = self._scores(residual, directions, moments)
        drawn_anywhere = torch.stack([score.detach() for score in scores]).amax(0).flatten() > constants.ALPHA_MIN
        children = drawn_anywhere.nonzero().squeeze(-1)

        drawn = gather(scaffold, children)
        uids = scaffold.child_uids(children)
        extent = float(self.extent)
        compositions = []
        answers = self._answers(drawn, children, [time for _, time in views])
        for score, change, towards, (canonical, raw) in zip(scores, changes, directions, answers, strict=True):
            colors = self.appearance.colors(features, towards, children)
            drawn_change = None
            if residual is not None and change is not None:
                drawn_change = residual.bounded(change.flatten(0, 1).index_select(0, children))
                colors = clip(colors + drawn_change[:, :3], 0.0, 1.0, projected=config.projected_clip)
            means, quats, log_scales = compose(canonical, drawn, raw, extent, projected_clip=config.projected_clip)
            gaussians = Gaussians(
                means=means,
                quats=quats,
                log_scales=log_scales,
                opacities=score.flatten().index_select(0, children),
                colors=colors,
                uids=uids,
            )
            moved = None if raw is None else deformation_from(raw, extent)
            compositions.append(Composition(gaussians, children, drawn.centres, moved, drawn_change, score.detach()))
        return compositions

    def _scores(
        self, residual: ResidualField | None, directions: Sequence[Tensor], moments: Sequence[Tensor]
    ) -> tuple[list[Tensor], list[Tensor | None]]:
        """Of each view: the opacity score [A, k] of every slot, and the residual field's answer, if it is asked."""
        scaffold, config = self.scaffold, self.config
        offsets = scaffold.opacity_offsets.unsqueeze(-1)
        features = scaffold.features
        source = features.detach() if config.residual_stop_gradient else features
        lasting: Tensor | None = None
        scores: list[Tensor] = []
        changes: list[Tensor | None] = []
        for towards, moment in zip(directions, moments, strict=True):
            if lasting is None or config.opacity_view:
                lasting = tanh(self.appearance.opacity_logits(features, towards) + offsets)
            change = None if residual is None else residual(source, moment)
            changes.append(change)
            scores.append(lasting if residual is None or change is None else lasting + residual.bounded(change[..., 3]))
        return scores, changes

    def directions(self, eye: ArrayLike) -> Float[Tensor, "anchor 3"]:
        """Unit vectors from the camera centre to every anchor (decision A21)."""
        anchors = self.scaffold.anchors
        towards = anchors - torch.as_tensor(np.asarray(eye, dtype=np.float64), dtype=anchors.dtype)
        return towards / towards.norm(dim=-1, keepdim=True).clamp_min(constants.NEAR)

    def deform(
        self, children: Int64[Tensor, " gaussian"], canonical_means: Float[Tensor, "gaussian 3"], time: float
    ) -> Deformation | None:
        """Offsets at `time` of drawn children (flat slots, ascending) with the canonical positions given, Eq. 7.

        None while the scene is static. The gradient is stopped, or not, as the configuration says.
        """
        if not self.temporal or (self.deformation is None and self.single is None):
            return None
        if self.single is not None:
            raw = self._single(self.single, gather(self.scaffold, children), canonical_means, time)[:, 7:]
        else:
            raw = self._moved(children, canonical_means, [time])[0]
        return deformation_from(raw, float(self.extent))

    def _answers(self, drawn: Children, children: Tensor, times: Sequence[float]) -> list[tuple[Tensor, Tensor | None]]:
        """What the networks say of the drawn children at each time: canonical geometry, and its change if it moves."""
        if self.single is not None:
            if not self.temporal:
                return [(self._single(self.single, drawn, drawn.centres, None)[:, :7], None)] * len(times)
            every = [self._single(self.single, drawn, drawn.centres, time) for time in times]
            return [(raw[:, :7], raw[:, 7:]) for raw in every]
        canonical = unlearned(drawn.centres) if self.static is None else self.static(self.scaffold.features, drawn)
        if not self.temporal or self.deformation is None:
            return [(canonical, None)] * len(times)
        return [(canonical, raw) for raw in self._moved(children, drawn.centres, times)]

    def _moved(self, children: Tensor, canonical_means: Tensor, times: Sequence[float]) -> list[Tensor]:
        """DeformNet's answer per child at each time, or one per anchor that all its children share."""
        assert self.deformation is not None
        moments = torch.tensor(times, dtype=canonical_means.dtype).unsqueeze(-1)
        if self.config.deformation == "anchor":
            used, place = torch.unique(children // self.scaffold.slots, return_inverse=True)
            shared = self.deformation(self.scaffold.anchors.index_select(0, used) / self.extent, moments)
            return [raw.index_select(0, place) for raw in shared.unbind(0)]
        return list(self.deformation(self._positions(canonical_means), moments).unbind(0))

    def _single(self, single: SingleMLP, drawn: Children, canonical_means: Tensor, time: float | None) -> Tensor:
        moment = None if time is None else torch.tensor([time], dtype=canonical_means.dtype)
        raw: Tensor = single(self.scaffold.features, drawn, self._positions(canonical_means), moment)
        return raw

    def _positions(self, canonical_means: Tensor) -> Tensor:
        """Where a deformation network sees the children: in units of the extent, as a constant if so configured."""
        return (canonical_means.detach() if self.config.stop_gradient else canonical_means) / self.extent
