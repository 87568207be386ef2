"""Scene: what was learned. Composes the Gaussians of one instant as seen from one place (Eq. 3-13).

Opacity is evaluated first, and a score at or below 1/255 leaves no trace in the picture: only anchors with a child that
may exceed it are asked for colours and residuals, and only children that do go through the geometry networks. This
changes no pixel. Knows nothing of pixels, images
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
from graings.camera.sampling_rate import SamplingRate
from graings.config import SceneConfig
from graings.gaussians import Gaussians
from graings.random import torch_stream
from graings.scene.appearance import CanonicalAppearance, ResidualField
from graings.scene.canonical import StaticMLP, default_geometry
from graings.scene.children import Children, compose, gather
from graings.scene.clip import clip
from graings.scene.deformation import Deformation, DeformationNetwork, SingleMLP, deformation_from
from graings.scene.saturate import tanh
from graings.scene.scaffold import Scaffold


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
    opacities: Float[Tensor, "anchor child"]  # score of every slot, o(t) where it may be drawn at all; no gradient
    blur: float  # low-pass that the Gaussians were trained to be seen with, px^2 where a view is as fine as `sampling`
    sampling: SamplingRate


class Scene(nn.Module):
    """The model. `temporal` off (static warm-up, or a single instant) leaves the time modules unevaluated.

    `extent` is the half-size of the content in normalised units; positions enter the networks divided by it. `sampling`
    is that of the views it is trained on: the low-pass is a part of what was learned, as large on the scene in every
    picture, of training too. `seed` is that of the networks' first weights.
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
        self.config = config
        self.scaffold = scaffold
        self.register_buffer("extent", torch.tensor(float(extent), dtype=scaffold.features.dtype))
        self.sampling = sampling
        self.temporal = False
        self.residual: ResidualField | None = None
        self.single: SingleMLP | None = None
        self.static: StaticMLP | None = None
        self.deformation: DeformationNetwork | None = None
        # Each network begins with the same weights whichever others there are: ablations differ by their part alone.
        with torch_stream(seed, "init.appearance"):
            self.appearance = CanonicalAppearance(config, initial_opacity)
        if config.residual:
            with torch_stream(seed, "init.residual"):
                self.residual = ResidualField(config)
        if config.single_mlp:
            with torch_stream(seed, "init.single"):
                self.single = SingleMLP(config)
        elif config.canonical:
            with torch_stream(seed, "init.static"):
                self.static = StaticMLP(config)
        if not config.single_mlp and config.deformation != "none":
            with torch_stream(seed, "init.deformation"):
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
        scaffold, config, slots = self.scaffold, self.config, self.scaffold.slots
        directions = [self.directions(eye) for eye, _ in views]
        times = [time for _, time in views]

        residual = self.residual if self.temporal else None
        lasting = self._canonical_opacities(directions)
        active = _active_anchors(lasting, 0.0 if residual is None else residual.scale)
        features = scaffold.features.index_select(0, active)
        source = features.detach() if config.residual_stop_gradient else features
        scores = [score.index_select(0, active) for score in lasting]
        directions = [towards.index_select(0, active) for towards in directions]
        changes: list[Tensor | None] = [None] * len(views)
        if residual is not None:
            changes = [
                residual(source, torch.tensor([time], dtype=features.dtype), towards)
                for time, towards in zip(times, directions, strict=True)
            ]
            scores = [
                score if change is None else score + residual.bounded(change[..., 3])
                for score, change in zip(scores, changes, strict=True)
            ]
        drawn_anywhere = torch.stack([score.detach() for score in scores]).amax(0).flatten() > constants.ALPHA_MIN
        places = drawn_anywhere.nonzero().squeeze(-1)  # of what is drawn among the slots of awake anchors
        children = active[places // slots] * slots + places % slots

        drawn = gather(scaffold, children)
        uids = scaffold.child_uids(children)
        extent = float(self.extent)
        compositions = []
        answers = self._predicted_geometry(drawn, children, times)
        every = zip(lasting, scores, changes, directions, answers, strict=True)
        for unchanged, score, change, towards, (canonical, raw) in every:
            colors = self.appearance.colors(features, towards, places)
            drawn_change = None
            if residual is not None and change is not None:
                drawn_change = residual.bounded(change.flatten(0, 1).index_select(0, places))
                colors = clip(colors + drawn_change[:, :3], 0.0, 1.0, projected=config.projected_clip)
            means, quats, log_scales = compose(canonical, drawn, raw, extent, projected_clip=config.projected_clip)
            gaussians = Gaussians(
                means=means,
                quats=quats,
                log_scales=log_scales,
                opacities=score.flatten().index_select(0, places),
                colors=colors,
                uids=uids,
            )
            moved = None if raw is None else deformation_from(raw, extent)
            opacities = unchanged.detach().index_copy(0, active, score.detach())
            compositions.append(
                Composition(
                    gaussians, children, drawn.centres, moved, drawn_change, opacities, config.blur, self.sampling
                )
            )
        return compositions

    def _canonical_opacities(self, directions: Sequence[Tensor]) -> list[Tensor]:
        """Of each view: the opacity score [A, k] of every slot before the residual field has spoken."""
        offsets = self.scaffold.opacity_offsets.unsqueeze(-1)
        scores: list[Tensor] = []
        for towards in directions:
            if not scores or self.config.opacity_view:
                scores.append(tanh(self.appearance.opacity_logits(self.scaffold.features, towards) + offsets))
            else:
                scores.append(scores[0])
        return scores

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
            raw = self._predicted_deformation(children, canonical_means, [time])[0]
        return deformation_from(raw, float(self.extent))

    def _predicted_geometry(
        self, drawn: Children, children: Tensor, times: Sequence[float]
    ) -> list[tuple[Tensor, Tensor | None]]:
        """What the networks say of the drawn children at each time: canonical geometry, and its change if it moves."""
        if self.single is not None:
            if not self.temporal:
                return [(self._single(self.single, drawn, drawn.centres, None)[:, :7], None)] * len(times)
            every = [self._single(self.single, drawn, drawn.centres, time) for time in times]
            return [(raw[:, :7], raw[:, 7:]) for raw in every]
        canonical = (
            default_geometry(drawn.centres) if self.static is None else self.static(self.scaffold.features, drawn)
        )
        if not self.temporal or self.deformation is None:
            return [(canonical, None)] * len(times)
        return [(canonical, raw) for raw in self._predicted_deformation(children, drawn.centres, times)]

    def _predicted_deformation(self, children: Tensor, canonical_means: Tensor, times: Sequence[float]) -> list[Tensor]:
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


def _active_anchors(lasting: Sequence[Float[Tensor, "anchor child"]], reach: float) -> Int64[Tensor, " awake"]:
    """Anchors with a child that may be drawn in one of the views: no residual adds more than `reach` to a score."""
    highest = torch.stack([score.detach().amax(-1) for score in lasting]).amax(0)
    return (highest + reach > constants.ALPHA_MIN).nonzero().squeeze(-1)
