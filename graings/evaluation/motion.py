"""Motion: how far a model's Gaussians are from true positions over time, where a capture knows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from graings.document import Document
from graings.scene.scene import Scene

Array = NDArray[np.float64]

NEIGHBOURS: Final = 8  # Gaussians that a point is followed with
MIN_OPACITY: Final = 0.05  # of these Gaussians: fainter ones are hardly seen, and nothing holds them to the surface
POINTS_AT_ONCE: Final = 25  # distances to all Gaussians in memory


class MotionMetrics(Document):
    """Distances of tracked surface points from their true positions, in units of the extent: the diagonal of the
    box around all positions at all times."""

    mean: float = Field(ge=0, description="Mean distance over points and times after the first, in extents.")
    percentile_90: float = Field(ge=0, description="Distance that nine tenths stay below, in extents.")
    mean_at_rest: float = Field(ge=0, description="The mean of a model in which nothing moves, in extents.")
    points: int = Field(gt=0, description="Number of points.")
    times: int = Field(gt=0, description="Number of times, the first included.")


def measure_motion(scene: Scene, eye: ArrayLike, times: Sequence[float], positions: ArrayLike) -> MotionMetrics | None:
    """Follow surface points with the Gaussians of `scene` and compare with true `positions` [T, M, 3] at `times`.

    At the first time each point takes the nearest Gaussians that are drawn from `eye` [3]; at later times it moves as
    they do on average, weighted by opacity and nearness. What Gaussians are off the surface at the first time is so no
    error of motion. Lengths are in normalised units, times in [0, 1]. None where there is only one time, or no
    Gaussian is opaque enough.
    """
    truth = np.asarray(positions, dtype=np.float64)
    if len(truth) < 2:
        return None
    with torch.inference_mode():
        composed = scene.compose(eye, times[0])
        opacities = composed.gaussians.opacities.double().numpy()
        solid = np.flatnonzero(opacities >= MIN_OPACITY)
        if not len(solid):
            return None
        means = composed.gaussians.means.double().numpy()[solid]
        children, canonical = (
            composed.children[torch.from_numpy(solid)],
            composed.canonical_means[torch.from_numpy(solid)],
        )
        offsets = []
        for time in times:
            deformation = scene.deform(children, canonical, time)
            moved = None if deformation is None else deformation.position_offsets(0).double().numpy()
            offsets.append(np.zeros_like(means) if moved is None else moved)
    displacements = np.stack(offsets) - offsets[0]
    return motion_error(follow(truth[0], means, opacities[solid], displacements), truth)


def follow(points: Array, means: Array, opacities: Array, displacements: Array) -> Array:
    """Positions [T, M, 3] of `points` [M, 3] that move with the Gaussians near them.

    `means` [N, 3] and `opacities` [N] are those at the first time, `displacements` [T, N, 3] those since.
    """
    count = min(NEIGHBOURS, len(means))
    followed = []
    for first in range(0, len(points), POINTS_AT_ONCE):
        part = points[first : first + POINTS_AT_ONCE]
        square = np.sum((part[:, None] - means) ** 2, axis=2)
        nearest = np.argpartition(square, count - 1, axis=1)[:, :count]
        distance = np.take_along_axis(square, nearest, axis=1)
        width = np.maximum(0.25 * distance.max(axis=1, keepdims=True), 1e-12)
        weights = opacities[nearest] * np.exp(-0.5 * distance / width)
        weights /= weights.sum(axis=1, keepdims=True)
        followed.append(part + np.einsum("mk,tmkc->tmc", weights, displacements[:, nearest]))
    return np.concatenate(followed, axis=1)


def motion_error(followed: Array, truth: Array) -> MotionMetrics:
    """Distances of `followed` [T, M, 3] from `truth` [T, M, 3], T at least 2; the first time is left out."""
    extent = max(float(np.linalg.norm(np.ptp(truth.reshape(-1, 3), axis=0))), 1e-12)
    distances = np.linalg.norm(followed[1:] - truth[1:], axis=2) / extent
    at_rest = np.linalg.norm(truth[:1] - truth[1:], axis=2) / extent
    return MotionMetrics(
        mean=float(distances.mean()),
        percentile_90=float(np.percentile(distances, 90)),
        mean_at_rest=float(at_rest.mean()),
        points=truth.shape[1],
        times=truth.shape[0],
    )
