"""Lens: how an undistorted image is sampled from a distorted photo.

Plain data plus the remap. The camera models themselves are those of pycolmap, an optional extra that is imported only
for distorted lenses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from graings.colmap import import_pycolmap

if TYPE_CHECKING:
    import pycolmap

# Models that are a pinhole when all distortion coefficients are zero. Fisheye models are not: without coefficients they
# still map angles to radii, although pycolmap's `is_undistorted` is true for them.
PINHOLE_AT_ZERO_DISTORTION: Final = frozenset(
    ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_DIVISION", "DIVISION")
)


@dataclass(frozen=True, slots=True)
class Lens:
    """A distorting camera (COLMAP's `model` name and `params` at `size`) and the pinhole that replaces it."""

    model: str
    params: tuple[float, ...]
    size: tuple[int, int]  # width, height of the photo
    pinhole: tuple[float, float, float, float]  # fx, fy, cx, cy of the undistorted image in px
    pinhole_size: tuple[int, int]  # width, height of the undistorted image

    @staticmethod
    def of(model: str, params: tuple[float, ...], size: tuple[int, int], distortion: tuple[float, ...]) -> Lens | None:
        """The lens of a COLMAP camera; None where it is a pinhole already.

        `distortion` is the part of `params` after the principal point. The undistorted image is the largest without
        blank borders. Raises `ImportError` without pycolmap and `ValueError` for a model or parameters that cannot be
        undistorted.
        """
        if model in PINHOLE_AT_ZERO_DISTORTION and not any(distortion):
            return None
        # An optional extra: an import at the top of the module would make every capture depend on it.
        pycolmap = import_pycolmap()
        camera = _camera(model, params, size)
        undistorted = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        fx, fy, cx, cy = (float(value) for value in undistorted.params)
        lens = Lens(model, params, size, (fx, fy, cx, cy), (undistorted.width, undistorted.height))
        # pycolmap accepts any parameters; a grid of points detects the blank borders that impossible ones give.
        u = np.linspace(0.5, undistorted.width - 0.5, 33)
        v = np.linspace(0.5, undistorted.height - 0.5, 33)
        grid = lens._distorted(u, v)
        if not ((grid > -1.0) & (grid < np.array(size) + 1.0)).all():  # False for NaN as well
            raise ValueError("its undistorted image reaches outside the photo")
        return lens

    def source_pixels(self) -> NDArray[np.float64]:
        """Position (x, y) in px of each undistorted pixel centre in the photo, [H, W, 2]."""
        width, height = self.pinhole_size
        return self._distorted(np.arange(width) + 0.5, np.arange(height) + 0.5)

    def _distorted(self, u: NDArray[np.floating], v: NDArray[np.floating]) -> NDArray[np.float64]:
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
        positions = self.source_pixels() - 0.5
        x, y = np.clip(positions, 0.0, (width - 1.0, height - 1.0)).reshape(-1, 2).T
        left, top = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
        # At the last row and column the weight of the next one is zero, so any index is right.
        right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
        wx, wy = (x - left).astype(np.float32), (y - top).astype(np.float32)
        corners = [row * width + column for row in (top, below) for column in (left, right)]
        weights = [(1 - wx) * (1 - wy), wx * (1 - wy), (1 - wx) * wy, wx * wy]
        undistorted = np.empty((*positions.shape[:2], image.shape[2]), dtype=np.float32)
        for channel in range(image.shape[2]):  # by channel: gathers from a contiguous plane are four times faster
            plane = np.ascontiguousarray(image[..., channel]).ravel()
            total = sum(plane[corner] * weight for corner, weight in zip(corners, weights, strict=True))
            undistorted[..., channel] = np.reshape(total, positions.shape[:2])
        return undistorted


def _camera(model: str, params: tuple[float, ...], size: tuple[int, int]) -> pycolmap.Camera:
    pycolmap = import_pycolmap()

    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=list(params))
    if not camera.verify_params():
        raise ValueError(f"{model} has another number of parameters than {len(params)}")
    return camera
