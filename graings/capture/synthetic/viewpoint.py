"""Viewpoint: a camera of the suite, with the same bits on every machine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from graings.capture.synthetic.exact import Array, Vector, cosine, cross, lengths, sine, unit
from graings.capture.synthetic.world import CameraPath

GOLDEN: Final = 0.6180339887498949  # (sqrt(5) - 1) / 2: steps of it fill an interval evenly however many there are
ELEVATION_STEP: Final = 0.5401815134754528  # golden^2 * sqrt(2)


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """A square pinhole camera with OpenCV axes; `focal` is in image widths, `size` in pixels."""

    origin: Vector
    right: Vector
    down: Vector
    forward: Vector
    focal: float
    size: int

    @property
    def pixel(self) -> float:
        """Width of a pixel at distance 1."""
        return 1.0 / (self.focal * self.size)

    def rays(self, columns: Array, rows: Array) -> tuple[Array, Array]:
        """Unit directions [3, N] of image positions in pixels, and the depth along the axis per unit of them [N]."""
        x = (columns / self.size - 0.5) / self.focal
        y = (rows / self.size - 0.5) / self.focal
        steps = np.stack([self.forward[i] + x * self.right[i] + y * self.down[i] for i in range(3)])
        length = lengths(steps)
        return steps / length, 1.0 / length

    def transform(self) -> list[list[float]]:
        """Camera-to-world matrix with OpenGL axes (y up, z back), as transforms files hold it."""
        rows = [[self.right[i], -self.down[i], -self.forward[i], self.origin[i]] for i in range(3)]
        return [[value + 0.0 for value in row] for row in rows] + [[0.0, 0.0, 0.0, 1.0]]

    def intrinsics(self) -> dict[str, Any]:
        """Keys of a transforms file."""
        angle = 2.0 * math.atan(0.5 / self.focal)
        pixels, center = self.focal * self.size, 0.5 * self.size
        # The angle is for programs that read nothing else; rounded, because an arc tangent is not correctly rounded.
        return {
            "camera_angle_x": round(angle, 12),
            "fl_x": pixels,
            "fl_y": pixels,
            "cx": center,
            "cy": center,
            "w": self.size,
            "h": self.size,
        }


def look(origin: Vector, target: Vector, focal: float, size: int) -> Viewpoint:
    """A level camera at `origin` that looks at `target`."""
    forward = unit((target[0] - origin[0], target[1] - origin[1], target[2] - origin[2]))
    right = unit(cross(forward, (0.0, 0.0, 1.0)))
    return Viewpoint(origin, right, cross(forward, right), forward, focal, size)


def on_path(path: CameraPath, index: int, start: float, size: int) -> Viewpoint:
    """Camera number `index` of a sequence that begins at `start` in [0, 1)."""
    a, b = start + index * GOLDEN, start + index * ELEVATION_STEP
    azimuth = path.azimuth[0] + (path.azimuth[1] - path.azimuth[0]) * (a - math.floor(a))
    elevation = path.elevation[0] + (path.elevation[1] - path.elevation[0]) * (b - math.floor(b))
    return _around(path, azimuth, elevation, size)


def on_rig(path: CameraPath, index: int, count: int, size: int) -> Viewpoint:
    """Fixed camera `index` of `count`: spread over the azimuth, at three heights in turn."""
    azimuth = path.azimuth[0] + (path.azimuth[1] - path.azimuth[0]) * index / count
    elevation = path.elevation[0] + (path.elevation[1] - path.elevation[0]) * (index % 3) / 2
    return _around(path, azimuth, elevation, size)


def _around(path: CameraPath, azimuth: float, elevation: float, size: int) -> Viewpoint:
    reach, height = path.distance * cosine(elevation), path.distance * sine(elevation)
    x, y, z = path.target
    origin = (x + reach * cosine(azimuth), y + reach * sine(azimuth), z + height)
    if path.box is not None:
        limited = [min(max(value, -half), half) for value, half in zip(origin, path.box, strict=True)]
        origin = (limited[0], limited[1], limited[2])
    return look(origin, path.target, path.focal, size)
