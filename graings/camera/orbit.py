"""Orbit: azimuth, elevation and distance of cameras around a point, about a vertical axis."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vectors = NDArray[np.float64]

# Length of the mean direction of cameras that stand on one side. Cameras spread evenly over an arc have 0.64 for half a
# turn, 0.30 for three quarters and 0 for a whole one; hundreds at random all around have less than 0.1.
_ONE_SIDED: Final = 0.3


def horizon(up: ArrayLike) -> tuple[Vectors, Vectors, Vectors]:
    """Unit vectors [3]: the vertical, and the horizontal directions of azimuth 0 and 90 degrees."""
    axis = np.asarray(up, dtype=np.float64)
    axis = axis / np.linalg.norm(axis)
    east = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    east = east / np.linalg.norm(east)
    return axis, east, np.cross(axis, east)


def azimuths(arms: ArrayLike, up: ArrayLike) -> Vectors:
    """Azimuths [N] in degrees of vectors [N, 3] from the point that is looked at; 0 for a vertical one."""
    _, east, north = horizon(up)
    arms_ = np.asarray(arms, dtype=np.float64)
    return np.degrees(np.arctan2(arms_ @ north, arms_ @ east))


def elevations(arms: ArrayLike, up: ArrayLike) -> Vectors:
    """Elevations [N] in degrees of vectors [N, 3] above the horizon; 0 for a vector of length 0."""
    axis, _, _ = horizon(up)
    arms_ = np.asarray(arms, dtype=np.float64)
    lengths = np.linalg.norm(arms_, axis=-1)
    return np.degrees(np.arcsin(np.clip(arms_ @ axis / np.where(lengths > 0, lengths, 1.0), -1.0, 1.0)))


def one_side(arms: ArrayLike, up: ArrayLike) -> float | None:
    """Mean azimuth in degrees of vectors [N, 3] that lie on one side of the vertical, None if they lie all around."""
    angles = np.radians(azimuths(arms, up))
    x, y = float(np.cos(angles).mean()), float(np.sin(angles).mean())
    return math.degrees(math.atan2(y, x)) if math.hypot(x, y) > _ONE_SIDED else None
