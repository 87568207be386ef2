"""bake: the PlayerScene of a model, in the order and with the steps in which it is stored."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from graings import constants
from graings.camera.camera import Camera, View
from graings.export.harmonics_fit import fit_colors, spread
from graings.player.scene import PlayerScene
from graings.render import PreparedScene, contributions
from graings.scene.motion_basis import PLAYER_PIXELS, MotionBasis
from graings.scene.time_basis import TimeBasis

# Single Gaussians may err by so many levels of 255: where several are blended their errors average out.
RESIDUAL_LEVELS: Final = 4.0
# Views that colours are fitted in.
MOST_VIEWS: Final = 60
# A Gaussian is visible up to so many standard deviations.
_REACH: Final = math.sqrt(-2 * math.log(constants.ALPHA_MIN))
_MORTON_BITS: Final = 10


@dataclass(frozen=True, slots=True)
class Sizes:
    """How large the scene is in the training views, for which 1 % of the Gaussians and views are larger."""

    rate: float  # px for a displacement of one normalised unit
    deviation: float  # largest standard deviation of a Gaussian, in px


@dataclass(frozen=True, slots=True, eq=False)
class Baked:
    """A scene with what is known of it."""

    scene: PlayerScene
    children: Int64[Tensor, " child"]  # row of each Gaussian in the `PreparedScene`
    sizes: Sizes
    color_error: float  # levels of 255


def bake(prepared: PreparedScene, views: Sequence[View], *, pixels: float = PLAYER_PIXELS) -> Baked:
    """`prepared` as it moves within `pixels` of the exact motion in the training `views`, at least one.

    Raises `ValueError` where no Gaussian can be seen or the motion is not finite.
    """
    if not prepared.children:
        raise ValueError("nothing of this model can be seen: train it longer, or use another checkpoint")
    with torch.no_grad():
        basis = MotionBasis.of(prepared, views, pixels=pixels, levels=RESIDUAL_LEVELS)
    harmonics, error = _harmonics(prepared, basis, [views[i] for i in spread(len(views), MOST_VIEWS)])
    harmonics[:, 0] += basis.color_offsets * math.sqrt(4 * math.pi)
    order, moving = _order(basis)
    scene = PlayerScene(
        means=basis.means[order],
        quats=torch.nn.functional.normalize(basis.quats[order], dim=-1),
        log_scales=basis.log_scales[order],
        opacities=basis.opacities[order],
        harmonics=harmonics[order],
        geometry=_reordered(basis.geometry, order, moving),
        residual=_reordered(basis.residual, order, len(order) if basis.residual.rank else 0),
        blur=prepared.scene.config.blur,
        sampling=prepared.scene.sampling,
    )
    # q and -q are the same rotation; one sign for all leaves fewer digits.
    signs = torch.where(scene.quats[:, :1] < 0, -1.0, 1.0)
    scene = replace(scene, quats=scene.quats * signs)
    cameras = [view.camera for view in views]
    return Baked(scene, order, sizes_of(scene, cameras), 255 * error)


def largest_rates(means: Float[Tensor, "child 3"], cameras: Sequence[Camera]) -> Float[Tensor, " child"]:
    """For each position the px of a displacement by one unit in the camera that shows it largest; 0: in none."""
    rates = means.new_zeros(len(means))
    for camera in (cameras[i] for i in spread(len(cameras), MOST_VIEWS)):
        depths = means @ means.new_tensor(camera.world_to_camera[2, :3]) + float(camera.world_to_camera[2, 3])
        here = max(camera.fx, camera.fy) / depths.clamp_min(constants.NEAR)
        rates = torch.maximum(rates, torch.where(depths > constants.NEAR, here, 0.0))
    return rates


def sizes_of(scene: PlayerScene, cameras: Sequence[Camera]) -> Sizes:
    """How large `scene` is in `cameras`."""
    rates = largest_rates(scene.means, cameras)
    deviations = rates * scene.log_scales.amax(1).exp()
    return Sizes(float(rates.quantile(0.99)), float(deviations.quantile(0.99)))


def value_sizes(sizes: Sizes, values: int) -> np.ndarray:
    """Px that each of the ten values of the geometry moves the edge of a Gaussian; levels of 255 for the residual's."""
    if values == 4:
        return np.full(4, 255.0)
    edge = _REACH * sizes.deviation
    return np.array([sizes.rate] * 3 + [2 * edge] * 4 + [edge] * 3)


def _harmonics(prepared: PreparedScene, basis: MotionBasis, views: Sequence[View]) -> tuple[Tensor, float]:
    """Harmonics of the canonical colours, weighted by what each Gaussian contributes to each view at its time."""
    colors = torch.stack([prepared.canonical_colors(view.camera.center) for view in views]).float()
    weights = torch.zeros(len(views), prepared.children)
    for index, view in enumerate(views):
        shown = prepared.compose(view.camera.center, view.time)
        weights[index, torch.searchsorted(basis.slots, shown.children)] = contributions(shown, view.camera).float()
    eyes = torch.tensor(np.array([view.camera.center for view in views]))
    return fit_colors(basis.means, eyes, colors, weights)


def _order(basis: MotionBasis) -> tuple[Int64[Tensor, " child"], int]:
    """Rows of the basis with the moving ones first, neighbours in space near each other; and how many move."""
    still = torch.ones(len(basis.means), dtype=torch.bool)
    still[basis.geometry.rows] = False
    order = np.lexsort((_morton(basis.means.numpy().astype(np.float64)), still.numpy()))
    return torch.from_numpy(order), len(basis.geometry.rows)


def _morton(points: np.ndarray) -> np.ndarray:
    """Position of each point [N, 3] on a space-filling curve."""
    low, high = np.quantile(points, 0.01, axis=0), np.quantile(points, 0.99, axis=0)
    last = (1 << _MORTON_BITS) - 1
    cells = np.clip((points - low) / np.maximum(high - low, 1e-12) * last, 0, last).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


def _reordered(basis: TimeBasis, order: Int64[Tensor, " child"], rows: int) -> TimeBasis:
    """`basis` for the first `rows` of `order`."""
    weights = torch.zeros(len(order), basis.rank).index_copy(0, basis.rows, basis.weights)
    return TimeBasis(torch.arange(rows), weights[order[:rows]].contiguous(), basis.functions)
