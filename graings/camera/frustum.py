"""Frustum: which Gaussians a camera can see at all, by their centre and largest standard deviation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera

# Added to every footprint, in px: those of `RasterSettings.compat` are rounded up and end at whole tiles of 16 px.
SLACK: Final = 18.0


@dataclass(frozen=True, slots=True, eq=False)
class Frustum:
    """The space in which `camera` draws Gaussians that are blurred by a variance `blur` (px^2).

    A Gaussian ends at `reach` standard deviations. Nothing nearer than `near` is drawn, and `margin` is that of
    `RasterSettings.frustum_margin`, which bounds the Jacobian of the projection.
    """

    camera: Camera
    near: float
    reach: float
    blur: float
    margin: float

    def packed(self) -> NDArray[np.float64]:
        """The 21 numbers that the kernel reads.

        World-to-camera rotation (9), centre (3), fx, fy, cx, cy, width, height, near, and a and b: a Gaussian at depth
        z with largest standard deviation s has a footprint of at most a + b s / z px to each side.
        """
        camera = self.camera
        tangents = [
            max(center, side - center) / focal + 0.5 * self.margin * side / focal
            for center, side, focal in ((camera.cx, camera.width, camera.fx), (camera.cy, camera.height, camera.fy))
        ]
        # The norm of the Jacobian at depth z is at most f / z sqrt(1 + tan^2), and roots of sums at most sums of roots.
        spread = max(camera.fx, camera.fy) * math.sqrt(1.0 + sum(tangent * tangent for tangent in tangents))
        return np.concatenate(
            [
                camera.world_to_camera[:3, :3].ravel(),
                camera.center,
                (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height),
                (self.near, self.reach * math.sqrt(self.blur) + SLACK, self.reach * spread),
            ]
        )
