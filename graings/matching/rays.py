"""Rays of pixels with known cameras, and the points in which two of them meet."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera

Array = NDArray[np.float64]

# Largest reprojection error in px: it leaves little room for wrong matches near the epipolar line.
MAX_REPROJECTION_ERROR: Final = 1.5

# Degrees between two rays, below which the depth of their intersection is too uncertain.
MIN_ANGLE: Final = 1.5


def ray_intersections(one: Camera, other: Camera, pixels: Array, others: Array) -> tuple[NDArray[np.int64], Array]:
    """Which pairs of pixels [m, 2] see one point, and these points: midway between the rays where they are closest."""
    a, b, base = _rays(one, pixels), _rays(other, others), other.center - one.center
    cosine = (a * b).sum(-1)
    wide = (np.arccos(np.clip(cosine, -1.0, 1.0)) > np.radians(MIN_ANGLE)).nonzero()[0]
    a, b, cosine = a[wide], b[wide], cosine[wide]
    along, across = a @ base, b @ base
    sine = 1.0 - cosine**2
    depth, depths = (along - cosine * across) / sine, (cosine * along - across) / sine
    points = 0.5 * (one.center + depth[:, None] * a + other.center + depths[:, None] * b)
    seen = _reprojects(one, points, pixels[wide]) & _reprojects(other, points, others[wide])
    met = (depth > 0) & (depths > 0) & seen
    return wide[met], points[met]


def directions(camera: Camera, pixels: Array) -> Array:
    """Directions in the world of pixels [m, 2], scaled to one unit of depth."""
    local = np.column_stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(pixels))]
    )
    towards: Array = local @ camera.world_to_camera[:3, :3]
    return towards


def _rays(camera: Camera, pixels: Array) -> Array:
    """Unit directions in the world of pixels [m, 2]."""
    towards = directions(camera, pixels)
    unit: Array = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    return unit


def _reprojects(camera: Camera, points: Array, pixels: Array) -> NDArray[np.bool_]:
    """Whether `points` [m, 3] lie in front of `camera` and project to within the largest error of `pixels` [m, 2]."""
    deep = in_front(camera, points)
    seen = np.zeros(len(points), np.bool_)
    at, _ = camera.project(points[deep])
    seen[deep] = np.linalg.norm(at - pixels[deep], axis=-1) < MAX_REPROJECTION_ERROR
    return seen


def in_front(camera: Camera, points: Array) -> NDArray[np.bool_]:
    """Which of `points` [m, 3] are in front of the camera."""
    ahead: NDArray[np.bool_] = (points - camera.center) @ camera.forward > 0
    return ahead
