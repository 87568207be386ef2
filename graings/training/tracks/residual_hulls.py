"""Residual hulls: where the content is that a model does not show, at every training time.

The hull of a time is made of the residuals of the few views nearest to it in time, so an object with large motion has
hardly moved within it. A point is inside if all of these views that see it differ from their images there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from graings.training.initialization.visual_hull import whole_pixels
from graings.training.tracks.frame_residual import FrameResidual

Points = NDArray[np.float64]

# Number of views that make a hull. All but one have to see a point, from directions that differ by MIN_ANGLE degrees:
# views of nearly one direction leave its depth open.
VIEWS: Final = 5
MIN_ANGLE: Final = 10.0

# Random points that are tried first, and then around those that are inside of any hull.
COARSE, FINE = 20_000, 100_000

# A hull of fewer points is too small to be followed. Below this share of the times there is nothing to follow.
MIN_POINTS: Final = 20
MIN_TIMES: Final = 0.8


def residual_hulls(
    residuals: Sequence[FrameResidual], half: float, generator: torch.Generator
) -> list[tuple[float, Points]] | None:
    """Times, ascending, and points [N, 3] of the hull at each, which are none where it is too small or too deep.

    None where most times have no hull. Points are tried in a cube of half-size `half` about the origin.
    """
    moments = np.array([residual.frame.time for residual in residuals])
    nearest = _nearest(moments)
    # A hull stands for the middle of its views: at the ends of the clip that is not the time they are nearest to.
    # In single precision, as tracks keep them: equal sets of views must not differ by rounding.
    times, first = np.unique(moments[nearest].mean(1).astype(np.float32), return_index=True)
    nearest = nearest[first]
    coarse = (torch.rand(COARSE, 3, generator=generator, dtype=torch.float64).numpy() * 2 - 1) * half
    inside = _inside(coarse, residuals, nearest)
    if inside.any(0).mean() < MIN_TIMES:
        return None
    found = coarse[inside.any(1)]
    spacing = 2 * half / COARSE ** (1 / 3)
    chosen = torch.randint(len(found), (FINE,), generator=generator).numpy()
    fine = found[chosen] + spacing * torch.randn(FINE, 3, generator=generator, dtype=torch.float64).numpy()
    inside = _inside(fine, residuals, nearest)
    hulls = []
    for time, at, views in zip(times.tolist(), inside.T, nearest, strict=True):
        hull = fine[at]
        narrow = len(hull) < MIN_POINTS or _angle(hull.mean(0), [residuals[view] for view in views]) < MIN_ANGLE
        hulls.append((time, hull[:0] if narrow else hull))
    return hulls if np.mean([len(hull) > 0 for _, hull in hulls]) >= MIN_TIMES else None


def _nearest(times: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices [T, VIEWS] of the views nearest in time to each of `times` [T]."""
    apart = np.abs(np.subtract.outer(times, times))
    return np.argsort(apart, axis=1, kind="stable")[:, :VIEWS]


def _inside(points: Points, residuals: Sequence[FrameResidual], nearest: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each of `points` [M, 3] is inside the hull of each time, [M, T]."""
    seen = np.empty((len(points), len(residuals)), np.bool_)
    differs = np.empty_like(seen)
    for view, residual in enumerate(residuals):
        columns, rows, within = whole_pixels(points, residual.frame.camera)
        cells = rows // residual.cell, columns // residual.cell
        seen[:, view] = within & residual.seen[cells]
        differs[:, view] = seen[:, view] & residual.differs[cells]
    inside = np.empty((len(points), len(nearest)), np.bool_)
    for time, views in enumerate(nearest):
        many = seen[:, views].sum(1) >= VIEWS - 1
        inside[:, time] = many & (differs[:, views] == seen[:, views]).all(1)
    return inside


def _angle(center: Points, residuals: Sequence[FrameResidual]) -> float:
    """The largest angle in degrees between directions from `center` [3] to the cameras."""
    ways = np.array([residual.frame.camera.center for residual in residuals]) - center
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip(ways @ ways.T, -1, 1).min())))
