"""Lens: how an undistorted picture is read out of a distorted photograph.

Plain data plus the remap. The camera models themselves are pycolmap's, an optional extra that is imported only when
a lens really is distorted. Knows nothing of poses, files or COLMAP's model folder.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pycolmap

# Models that are a pinhole when all their distortion is zero. (Fisheye models are not: without coefficients they still
# map angles to radii; pycolmap's `is_undistorted` says otherwise.)
STRAIGHT_AT_ZERO: Final = frozenset(
    ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_DIVISION", "DIVISION")
)


@dataclass(frozen=True, slots=True)
class Lens:
    """A distorting camera (COLMAP's `model` name and `params` at `size`) and the pinhole that replaces it."""

    model: str
    params: tuple[float, ...]
    size: tuple[int, int]  # width, height of the photograph
    pinhole: tuple[float, float, float, float]  # fx, fy, cx, cy of the undistorted picture in px
    pinhole_size: tuple[int, int]  # width, height of the undistorted picture

    @staticmethod
    def of(model: str, params: tuple[float, ...], size: tuple[int, int], distortion: tuple[float, ...]) -> Lens | None:
        """The lens of a COLMAP camera, or None where it is a pinhole and nothing has to be remapped.

        `distortion` are those of `params` behind the principal point.

        The pinhole is the largest without blank borders. Raises `ImportError` without pycolmap and `ValueError` for
        a model or parameters that cannot be undistorted.
        """
        if model in STRAIGHT_AT_ZERO and not any(distortion):
            return None
        # Optional extra: importing it at the top would make every capture depend on it.
        import pycolmap

        camera = _camera(model, params, size)
        flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        fx, fy, cx, cy = (float(value) for value in flat.params)
        lens = Lens(model, params, size, (fx, fy, cx, cy), (flat.width, flat.height))
        # pycolmap answers for any numbers: what it promises, no blank borders, is what absurd ones break.
        u = np.linspace(0.5, flat.width - 0.5, 33)
        v = np.linspace(0.5, flat.height - 0.5, 33)
        probe = lens._photograph(u, v)
        if not ((probe > -1.0) & (probe < np.array(size) + 1.0)).all():  # False for NaN as well
            raise ValueError("its undistorted picture reaches outside the photograph")
        return lens

    def source_pixels(self) -> NDArray[np.float64]:
        """Where each undistorted pixel centre lies in the photograph, [H, W, 2] (x, y)."""
        width, height = self.pinhole_size
        return self._photograph(np.arange(width) + 0.5, np.arange(height) + 0.5)

    def _photograph(self, u: NDArray[np.floating], v: NDArray[np.floating]) -> NDArray[np.float64]:
        fx, fy, cx, cy = self.pinhole
        x, y = np.meshgrid((u - cx) / fx, (v - cy) / fy)
        rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
        pixels = _camera(self.model, self.params, self.size).img_from_cam(rays)
        return np.asarray(pixels, dtype=np.float64).reshape(len(v), len(u), 2)

    def undistort(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """`image` [H, W, C] at `size`, sampled bilinearly at `source_pixels`; premultiplied alpha is expected."""
        width, height = self.size
        if image.shape[:2] != (height, width):
            raise ValueError(f"image must be {width}x{height}, got {image.shape[1]}x{image.shape[0]}")
        at = self.source_pixels() - 0.5
        x, y = np.clip(at, 0.0, (width - 1.0, height - 1.0)).reshape(-1, 2).T
        left, top = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
        # At the last row and column the weight of the next one is zero: any pixel will do.
        right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
        wx, wy = (x - left).astype(np.float32), (y - top).astype(np.float32)
        corners = [row * width + column for row in (top, below) for column in (left, right)]
        weights = [(1 - wx) * (1 - wy), wx * (1 - wy), (1 - wx) * wy, wx * wy]
        mixed = np.empty((*at.shape[:2], image.shape[2]), dtype=np.float32)
        for channel in range(image.shape[2]):  # one plane at a time: long gathers are four times faster
            plane = np.ascontiguousarray(image[..., channel]).ravel()
            total = sum(plane[corner] * weight for corner, weight in zip(corners, weights, strict=True))
            mixed[..., channel] = np.reshape(total, at.shape[:2])
        return mixed


def _camera(model: str, params: tuple[float, ...], size: tuple[int, int]) -> pycolmap.Camera:
    import pycolmap  # optional extra, as above

    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=list(params))
    if not camera.verify_params():
        raise ValueError(f"{model} does not take {len(params)} parameters")
    return camera
