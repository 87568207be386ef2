"""Units: conversion between a capture's lengths and times and normalised ones.

Lengths are scaled by a power of two, which is exact in floating point: a capture scaled by 2^k trains and renders
to the same bits. Times are mapped to [0, 1] in float64 before they are converted to float32.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graings.camera.camera import Camera


@dataclass(frozen=True, slots=True)
class Units:
    """x' = scale (x - center), t' = (t - time_start) / time_span; `time_span` 0 means a single time.

    `up` is the capture's vertical axis, unit length, for orbits around the scene.
    """

    center: tuple[float, float, float]
    scale: float
    time_start: float = 0.0
    time_span: float = 0.0
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0 and math.frexp(self.scale)[0] == 0.5):
            raise ValueError(f"scale must be a power of two, got {self.scale}")

    def points(self, points: ArrayLike) -> NDArray[np.float64]:
        """Capture positions [..., 3] in normalised units."""
        shifted: NDArray[np.float64] = np.asarray(points, dtype=np.float64) - np.asarray(self.center)
        return shifted * self.scale

    def points_back(self, points: ArrayLike) -> NDArray[np.float64]:
        """Normalised positions [..., 3] in the capture's units."""
        scaled: NDArray[np.float64] = np.asarray(points, dtype=np.float64) / self.scale
        return scaled + np.asarray(self.center)

    def camera(self, world_to_camera: ArrayLike) -> NDArray[np.float64]:
        """A capture's world-to-camera pose [4, 4] in normalised units."""
        pose = np.array(world_to_camera, dtype=np.float64)
        pose[:3, 3] = (pose[:3, :3] @ np.asarray(self.center) + pose[:3, 3]) * self.scale
        return pose

    def camera_back(self, camera: Camera) -> NDArray[np.float64]:
        """World-to-camera pose [4, 4] of a normalised camera in the capture's units."""
        pose = np.array(camera.world_to_camera)
        pose[:3, 3] = pose[:3, 3] / self.scale - pose[:3, :3] @ np.asarray(self.center)
        return pose

    def time(self, time: float) -> float:
        """A capture's time stamp mapped to [0, 1] (0 if the capture has a single time)."""
        return (float(time) - self.time_start) / self.time_span if self.time_span > 0 else 0.0
