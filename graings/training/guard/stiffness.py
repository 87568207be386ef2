"""Stiffness: whether the optimiser's steps fit the sizes of what they move, and how much is too small for any view.

Steps longer than the Gaussians they move shake a scene instead of shaping it, and the scales of a Gaussian far smaller
than a pixel get next to no gradient: the low-pass of the footprint hides them. Knows nothing of schedules or losses.
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
from graings.scene.scene import Scene

# Share of Gaussians whose step is no longer than `step_over_size` says.
SHARE: Final = 0.99

# Above this a step is longer than what it moves.
STIFF: Final = 1.0

# A footprint below this many px, both axes together, is too small for its scales to be learned.
SUBPIXEL: Final = 0.1

# Fainter Gaussians count as unseen: their footprint ends where it begins.
SEEN: Final = 2 * constants.ALPHA_MIN


@dataclass(frozen=True, slots=True)
class Stiffness:
    """What one moment of training says: kappa_step and f_sub, None where nothing was measured or is drawn.

    `views` is how many training views `subpixel_share` looked at.
    """

    step_over_size: float | None
    subpixel_share: float | None
    views: int

    @property
    def stiff(self) -> bool:
        """Whether the last step that was measured was too long for the scene."""
        return self.step_over_size is not None and self.step_over_size > STIFF

    def events(self, iteration: int) -> tuple[Stiff, ...]:
        """The event of a run that ended like this after `iteration`, if it was stiff."""
        if self.step_over_size is None or not self.stiff:
            return ()
        return (Stiff(iteration=iteration, step_over_size=self.step_over_size),)


def step_over_size(before: Gaussians, after: Gaussians, camera: Camera, blur: float) -> float | None:
    """kappa_step: how far one step moved Gaussians over their own size in that direction, 99th percentile.

    The size is what `camera` can see of it, with the low-pass of the footprint (`blur`, px^2) at its distance: a disc
    thinner than any pixel, moved by its own thickness, moves nothing. Of those drawn both times, known by their uids;
    None where there are none, or where one of them is lost. Both are of the same instant.
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


@torch.no_grad()
def subpixel_share(scene: Scene, frames: Sequence[Frame], background: Sequence[float]) -> float | None:
    """f_sub: share of the Gaussians seen in `frames` whose footprint stays below a tenth of a pixel in all of them.

    None where none is seen.
    """
    slots = scene.scaffold.count * scene.scaffold.slots
    seen, wide = torch.zeros(slots, dtype=torch.bool), torch.zeros(slots, dtype=torch.bool)
    for frame in frames:
        composition = scene.compose(frame.camera.center, frame.time)
        gaussians, radii = composition.gaussians, draw(composition, frame.camera, background).radii
        visible = (radii.amax(1) > 0) & (gaussians.opacities > SEEN)
        seen[composition.children[visible]] = True
        sizes = footprints(gaussians, radii, low_pass(composition, frame.camera))
        wide[composition.children[visible & (sizes >= SUBPIXEL)]] = True
    count = int(seen.sum())
    return int((seen & ~wide).sum()) / count if count else None


def footprints(gaussians: Gaussians, radii: Float[Tensor, "gaussian 2"], blur: float) -> Float[Tensor, " gaussian"]:
    """Size in px of what was drawn with `radii`: the root of the sum of both squared axes, without the low-pass `blur`.

    A radius is where alpha falls below the least that is drawn: sqrt(2 ln(o / alpha_min) (variance + blur)). Means
    something where a Gaussian was drawn, and more than just so.
    """
    level = 2 * (gaussians.opacities.double() / constants.ALPHA_MIN).log()
    variances = radii.double().square() / level.unsqueeze(1) - blur
    return variances.sum(1).clamp_min(0).sqrt()
