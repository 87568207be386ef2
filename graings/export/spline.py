"""spline: a smooth path of cameras through keys."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.camera.viewpoint import sized


@dataclass(frozen=True, slots=True, eq=False)
class PathKey:
    """A camera (normalised units) and a time in [0, 1], or None where the file names none."""

    camera: Camera
    time: float | None


def spline(keys: Sequence[PathKey], count: int, *, closed: bool = False) -> list[PathKey]:
    """`count` cameras along a Catmull-Rom spline through `keys`, at equal distances of the parameter.

    Positions, rotations (projected onto the nearest rotation), log focal lengths and times are interpolated, times
    linearly; the image size is that of the first key, and keys of another shape keep their horizontal field of view.
    A closed spline returns to its first key without repeating it, and so do its times.
    """
    poses = [np.linalg.inv(key.camera.world_to_camera) for key in keys]
    size = keys[0].camera
    lenses = [_lens(key.camera, size) for key in keys]
    rows = np.stack([np.concatenate([p[:3].ravel(), lens]) for p, lens in zip(poses, lenses, strict=True)])
    timed = all(key.time is not None for key in keys)
    moments = [*keys, keys[0]] if closed else keys
    times = np.array([key.time for key in moments], dtype=np.float64) if timed else None
    segments = len(keys) if closed else len(keys) - 1
    found = []
    for index in range(count):
        place = segments * index / (count if closed else max(1, count - 1))
        row = _catmull_rom(rows, place, closed)
        left, _, right = np.linalg.svd(row[:12].reshape(3, 4)[:, :3])
        pose = np.eye(4)
        pose[:3, :3] = (left * [1, 1, np.linalg.det(left @ right)] @ right).T
        pose[:3, 3] = -pose[:3, :3] @ row[:12].reshape(3, 4)[:, 3]
        fx, fy = np.exp(row[12:14])
        camera = Camera(pose, float(fx), float(fy), float(row[14]), float(row[15]), size.width, size.height)
        moment = None if times is None else float(np.interp(place, np.arange(len(moments)), times))
        found.append(PathKey(camera, moment))
    return found


def _lens(camera: Camera, size: Camera) -> NDArray[np.float64]:
    """Log focal lengths and principal point at the image size of `size`."""
    camera = sized(camera, size.width, size.height)
    return np.array([math.log(camera.fx), math.log(camera.fy), camera.cx, camera.cy])


def _catmull_rom(rows: NDArray[np.float64], place: float, closed: bool) -> NDArray[np.float64]:
    count = len(rows)
    start = min(int(place), count - 1 if closed else max(0, count - 2))
    u = place - start
    p, q, r, s = (rows[(start + k) % count if closed else min(max(start + k, 0), count - 1)] for k in (-1, 0, 1, 2))
    found: NDArray[np.float64] = q + 0.5 * u * (r - p + u * (2 * p - 5 * q + 4 * r - s + u * (3 * (q - r) + s - p)))
    return found
