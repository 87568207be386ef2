"""Camera: intrinsics and pose. View: a camera at a time.

Axes are OpenCV's: x right, y down, z forward. Pixel (i, j) has its centre at (i + 0.5, j + 0.5).
All lengths are in normalised units (`graings.camera.units`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graings.camera.orbit import horizon

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
_MIN_DEPTH = 1e-9  # smaller depths are replaced by this one when arbitrary points are projected
_ORTHONORMAL_TOLERANCE = 1e-12  # rounding of an orthonormal float64 matrix; such a matrix is left unchanged


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera.

    `world_to_camera` is [4, 4] float64 and rigid; a rotation rounded to single precision is replaced by the nearest
    exact one, so that the centre and the translation agree. `fx, fy, cx, cy` are in pixels: u = fx X/Z + cx,
    v = fy Y/Z + cy. Raises `ValueError` for a pose that is not rigid and for intrinsics or sizes out of range.
    """

    world_to_camera: Matrix
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    center: Vector = field(init=False, repr=False)  # position of the camera in the world, [3]

    def __post_init__(self) -> None:
        pose = np.array(self.world_to_camera, dtype=np.float64)
        if pose.shape != (4, 4):
            raise ValueError(f"world_to_camera must have shape (4, 4), got {pose.shape}")
        if not np.isfinite(pose).all():
            raise ValueError("world_to_camera must be finite")
        rotation = pose[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
            raise ValueError("world_to_camera must be rigid: a rotation (no mirror, no scale) and a translation")
        if not np.allclose(pose[3], (0.0, 0.0, 0.0, 1.0), atol=1e-9):
            raise ValueError(f"world_to_camera must end in the row (0, 0, 0, 1), got {pose[3].tolist()}")
        intrinsics = (self.fx, self.fy, self.cx, self.cy)
        if not all(math.isfinite(value) for value in intrinsics) or self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"intrinsics must be finite with fx, fy > 0, got {intrinsics}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"image size must be at least 1x1, got {self.width}x{self.height}")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ORTHONORMAL_TOLERANCE:
            left, _, right = np.linalg.svd(rotation)
            pose[:3, :3] = left @ right
        pose.flags.writeable = False
        object.__setattr__(self, "world_to_camera", pose)
        object.__setattr__(self, "center", -pose[:3, :3].T @ pose[:3, 3])

    @property
    def forward(self) -> Vector:
        """Unit viewing direction in the world, [3]."""
        return np.array(self.world_to_camera[2, :3])

    @property
    def horizontal_fov(self) -> float:
        """Full horizontal field of view in radians."""
        return 2.0 * math.atan2(self.width, 2.0 * self.fx)

    def resized(self, width: int, height: int) -> Camera:
        """The same field of view sampled by `width` x `height` pixels."""
        sx, sy = width / self.width, height / self.height
        return Camera(self.world_to_camera, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height)

    def project(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Projected positions [M, 2] in px and depths [M] of `points` [M, 3].

        The position of a point that is not in front of the camera is finite but has no meaning.
        """
        local = points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        depth = np.maximum(local[:, 2], _MIN_DEPTH)
        x, y = self.fx * local[:, 0] / depth + self.cx, self.fy * local[:, 1] / depth + self.cy
        return np.column_stack([x, y]), local[:, 2]

    @staticmethod
    def look_at(
        eye: ArrayLike,
        target: ArrayLike,
        *,
        up: ArrayLike = (0.0, 0.0, 1.0),
        fov: float,
        width: int,
        height: int,
    ) -> Camera:
        """A camera at `eye` [3] looking at `target` [3]; `fov` is the full horizontal angle in radians."""
        eye_, target_, up_ = (np.asarray(v, dtype=np.float64) for v in (eye, target, up))
        forward = target_ - eye_
        distance = float(np.linalg.norm(forward))
        if not math.isfinite(distance) or distance < 1e-12:
            raise ValueError("eye and target must be finite and apart")
        forward = forward / distance
        right = np.cross(forward, up_)
        if np.linalg.norm(right) < 1e-6 * np.linalg.norm(up_):
            # The camera looks along `up`: use the world axis farthest from the viewing direction instead.
            right = np.cross(forward, np.eye(3)[int(np.argmin(np.abs(forward)))])
        right = right / np.linalg.norm(right)
        down = np.cross(forward, right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, down, forward])
        pose[:3, 3] = -pose[:3, :3] @ eye_
        if not 0.0 < fov < math.pi:
            raise ValueError(f"fov must lie in (0, pi) radians, got {fov}")
        focal = 0.5 * width / math.tan(0.5 * fov)
        return Camera(pose, focal, focal, 0.5 * width, 0.5 * height, width, height)

    @staticmethod
    def orbit(
        azimuth: float,
        elevation: float,
        radius: float,
        *,
        target: ArrayLike = (0.0, 0.0, 0.0),
        up: ArrayLike = (0.0, 0.0, 1.0),
        fov: float,
        width: int,
        height: int,
    ) -> Camera:
        """A camera on a sphere around `target`; angles in degrees, azimuth about `up`, elevation from the horizon."""
        axis, east, north = horizon(up)
        a, e = math.radians(azimuth), math.radians(elevation)
        offset = math.cos(e) * (math.cos(a) * east + math.sin(a) * north) + math.sin(e) * axis
        eye = np.asarray(target, dtype=np.float64) + radius * offset
        return Camera.look_at(eye, target, up=axis, fov=fov, width=width, height=height)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A named camera at a time; `time` is normalised to [0, 1]."""

    name: str
    camera: Camera
    time: float
