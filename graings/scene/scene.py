"""Scene: what was learned. Composes the Gaussians of one instant as seen from one place (Eq. 3-13).

Opacity is evaluated first and only children that will be drawn go through the geometry networks: a score
at or below 1/255 leaves no trace in the picture, so this changes no pixel. Knows nothing of pixels, images
or losses.
"""

from __future__ import annotations

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
    """The drawn children of one instant, with everything the losses and the growth statistics look at."""

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
        scaffold, config = self.scaffold, self.config
        dtype = scaffold.features.dtype
        features = scaffold.features
        moment = torch.tensor([time], dtype=dtype)
        directions = self.directions(eye)

        scores = tanh(self.appearance.opacity_logits(features, directions) + scaffold.opacity_offsets.unsqueeze(-1))
        change: Tensor | None = None
        residual = self.residual if self.temporal else None
        if residual is not None:
            source = features.detach() if config.residual_stop_gradient else features
            change = residual(source, moment)
            scores = scores + residual.bounded(change[..., 3])

        children = (scores.detach().flatten() > constants.ALPHA_MIN).nonzero().squeeze(-1)
        colors = self.appearance.colors(features, directions, children)
        drawn_change = None
        if residual is not None and change is not None:
            drawn_change = residual.bounded(change.flatten(0, 1).index_select(0, children))
            colors = clip(colors + drawn_change[:, :3], 0.0, 1.0, projected=config.projected_clip)

        drawn = gather(scaffold, children)
        canonical, raw = self._answers(drawn, children, time)
        extent = float(self.extent)
        means, quats, log_scales = compose(canonical, drawn, raw, extent, projected_clip=config.projected_clip)
        gaussians = Gaussians(
            means=means,
            quats=quats,
            log_scales=log_scales,
            opacities=scores.flatten().index_select(0, children),
            colors=colors,
            uids=scaffold.child_uids(children),
        )
        moved = None if raw is None else deformation_from(raw, extent)
        return Composition(gaussians, children, drawn.centres, moved, drawn_change, scores.detach())

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
            raw = self._moved(children, canonical_means, time)
        return deformation_from(raw, float(self.extent))

    def _answers(self, drawn: Children, children: Tensor, time: float) -> tuple[Tensor, Tensor | None]:
        """What the networks say of the drawn children: canonical geometry, and its change unless nothing moves."""
        if self.single is not None:
            raw = self._single(self.single, drawn, drawn.centres, time if self.temporal else None)
            return raw[:, :7], raw[:, 7:] if self.temporal else None
        canonical = unlearned(drawn.centres) if self.static is None else self.static(self.scaffold.features, drawn)
        moves = self.temporal and self.deformation is not None
        return canonical, self._moved(children, drawn.centres, time) if moves else None

    def _moved(self, children: Tensor, canonical_means: Tensor, time: float) -> Tensor:
        """DeformNet's answer per child, or one per anchor that all its children share."""
        assert self.deformation is not None
        moment = torch.tensor([time], dtype=canonical_means.dtype)
        if self.config.deformation == "anchor":
            used, place = torch.unique(children // self.scaffold.slots, return_inverse=True)
            shared: Tensor = self.deformation(self.scaffold.anchors.index_select(0, used) / self.extent, moment)
            return shared.index_select(0, place)
        own: Tensor = self.deformation(self._positions(canonical_means), moment)
        return own

    def _single(self, single: SingleMLP, drawn: Children, canonical_means: Tensor, time: float | None) -> Tensor:
        moment = None if time is None else torch.tensor([time], dtype=canonical_means.dtype)
        raw: Tensor = single(self.scaffold.features, drawn, self._positions(canonical_means), moment)
        return raw

    def _positions(self, canonical_means: Tensor) -> Tensor:
        """Where a deformation network sees the children: in units of the extent, as a constant if so configured."""
        return (canonical_means.detach() if self.config.stop_gradient else canonical_means) / self.extent
