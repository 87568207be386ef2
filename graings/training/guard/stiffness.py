"""Stiffness: the length of the optimiser's steps relative to the Gaussians they move, and the share of Gaussians
too small for any view.

Steps longer than the Gaussians they move make training oscillate. The scales of a Gaussian far smaller than a pixel
get next to no gradient, because the low-pass filter dominates its footprint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize, pad

from graings import constants
from graings.camera.camera import Camera
from graings.capture.capture import Frame
from graings.gaussians import Gaussians
from graings.render import draw, low_pass
from graings.report.events import Stiff
from graings.scene.children import quaternion_product
from graings.scene.prepared import PreparedScene
from graings.scene.scene import Composed, Scene

# Share of Gaussians whose step is no longer than `step_over_size` says.
SHARE: Final = 0.99

# Above this a step is longer than the Gaussian it moves.
STIFF: Final = 1.0

# A footprint below this many px, both axes together, is too small for its scales to be learned.
SUBPIXEL: Final = 0.1

# Below this opacity the footprint is too small to be measured: such Gaussians count as not seen.
SEEN: Final = 2 * constants.ALPHA_MIN


@dataclass(frozen=True, slots=True)
class Stiffness:
    """kappa_step and f_sub at one iteration; None where nothing was measured or drawn.

    `views` is how many views `subpixel_share` looked at: held-out ones along the curve, training views at the end.
    """

    step_over_size: float | None
    subpixel_share: float | None
    views: int

    @property
    def stiff(self) -> bool:
        """Whether the last measured step was longer than the Gaussians it moved."""
        return self.step_over_size is not None and self.step_over_size > STIFF

    def events(self, iteration: int) -> tuple[Stiff, ...]:
        """The event of a run that ended like this after `iteration`, if it was stiff."""
        if self.step_over_size is None or not self.stiff:
            return ()
        return (Stiff(iteration=iteration, step_over_size=self.step_over_size),)


def step_over_size(before: Gaussians, after: Gaussians, camera: Camera, blur: float) -> float | None:
    """kappa_step: how far one step moved Gaussians, over their size in that direction, 99th percentile.

    The size includes the low-pass filter (`blur`, px^2) of `camera` at its distance: a disc much thinner than a pixel
    that moves by its own thickness changes no pixel. Both sets are of the same time; Gaussians drawn in both, matched
    by uid, count. None where there are none, or one is not finite.
    """
    uids = (before.uids.numpy(), after.uids.numpy())
    _, here, there = np.intersect1d(*uids, assume_unique=True, return_indices=True)
    if len(here) == 0:
        return None
    means, quats = after.means.detach()[there].double(), normalize(after.quats.detach()[there].double(), dim=1)
    moved = pad(means - before.means.detach()[here].double(), (1, 0))  # as a quaternion without a real part
    conjugates = quats * quats.new_tensor([1, -1, -1, -1])
    along = quaternion_product(quaternion_product(conjugates, moved), quats)[:, 1:]  # in each Gaussian's own axes
    pixel = (means - torch.from_numpy(camera.center)).norm(dim=1, keepdim=True) / camera.fx
    sizes = (after.log_scales.detach()[there].double().mul(2).exp() + blur * pixel.square()).sqrt()
    lengths = (along / sizes).norm(dim=1)
    return float(np.quantile(lengths.numpy(), SHARE)) if bool(lengths.isfinite().all()) else None


class SubpixelCounter:
    """f_sub: share of the Gaussians seen in a set of views whose footprint is below 0.1 px in all of them."""

    def __init__(self, scene: Scene) -> None:
        slots = scene.scaffold.count * scene.scaffold.slots
        self._seen = torch.zeros(slots, dtype=torch.bool)
        self._wide = torch.zeros(slots, dtype=torch.bool)
        self.views = 0

    @torch.no_grad()
    def add(self, composition: Composed, radii: Float[Tensor, "gaussian 2"], camera: Camera) -> None:
        """Count one view that was drawn with `radii`."""
        gaussians = composition.gaussians
        visible = (radii.amax(1) > 0) & (gaussians.opacities > SEEN)
        self._seen[composition.children[visible]] = True
        sizes = footprints(gaussians, radii, low_pass(composition, camera))
        self._wide[composition.children[visible & (sizes >= SUBPIXEL)]] = True
        self.views += 1

    def share(self) -> float | None:
        """The share over the views so far; None where no Gaussian was seen."""
        count = int(self._seen.sum())
        return int((self._seen & ~self._wide).sum()) / count if count else None


@torch.no_grad()
def subpixel_share(scene: Scene, frames: Sequence[Frame], background: Sequence[float]) -> float | None:
    """f_sub over the views `frames`, each drawn once."""
    counter, prepared = SubpixelCounter(scene), PreparedScene(scene)
    for frame in frames:
        composition = prepared.compose(frame.camera.center, frame.time)
        counter.add(composition, draw(composition, frame.camera, background).radii, frame.camera)
    return counter.share()


def footprints(gaussians: Gaussians, radii: Float[Tensor, "gaussian 2"], blur: float) -> Float[Tensor, " gaussian"]:
    """Size in px of what was drawn with `radii`: the root of the sum of both squared axes, without the low-pass `blur`.

    A radius is where alpha falls below the least that is drawn: sqrt(2 ln(o / alpha_min) (variance + blur)). Means
    something where a Gaussian was drawn, and more than just so.
    """
    level = 2 * (gaussians.opacities.double() / constants.ALPHA_MIN).log()
    variances = radii.double().square() / level.unsqueeze(1) - blur
    return variances.sum(1).clamp_min(0).sqrt()
