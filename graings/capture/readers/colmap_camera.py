"""ColmapCamera: intrinsics as COLMAP writes them, the language in which all readers speak of lenses.

Knows nothing of poses, of COLMAP's files or of image files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from graings.capture.lens import Lens
from graings.errors import CaptureError

# By the id in cameras.bin: name, number of parameters, number of focal lengths that lead them (cx, cy follow).
CAMERA_MODELS: Final[dict[int, tuple[str, int, int]]] = {
    0: ("SIMPLE_PINHOLE", 3, 1),
    1: ("PINHOLE", 4, 2),
    2: ("SIMPLE_RADIAL", 4, 1),
    3: ("RADIAL", 5, 1),
    4: ("OPENCV", 8, 2),
    5: ("OPENCV_FISHEYE", 8, 2),
    6: ("FULL_OPENCV", 12, 2),
    7: ("FOV", 5, 2),
    8: ("SIMPLE_RADIAL_FISHEYE", 4, 1),
    9: ("RADIAL_FISHEYE", 5, 1),
    10: ("THIN_PRISM_FISHEYE", 12, 2),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16, 2),
    12: ("SIMPLE_DIVISION", 4, 1),
    13: ("DIVISION", 5, 2),
    14: ("SIMPLE_FISHEYE", 3, 1),
    15: ("FISHEYE", 4, 2),
    16: ("EUCM", 6, 2),
}
MODELS: Final = {name: (count, focals) for name, count, focals in CAMERA_MODELS.values()}


@dataclass(frozen=True, slots=True)
class ColmapCamera:
    """`params` are focal lengths, principal point, then distortion."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy without the distortion."""
        focals = MODELS[self.model][1]
        cx, cy = self.params[focals : focals + 2]
        return self.params[0], self.params[focals - 1], cx, cy

    @property
    def distortion(self) -> tuple[float, ...]:
        """The parameters behind the principal point."""
        return self.params[MODELS[self.model][1] + 2 :]

    def scaled(self, width: int, height: int) -> ColmapCamera:
        """The same camera for pictures of another size and the same shape."""
        sx, sy = width / self.width, height / self.height
        focals = MODELS[self.model][1]
        factors = ([sx] if focals == 1 else [sx, sy]) + [sx, sy] + [1.0] * len(self.distortion)
        params = tuple(value * factor for value, factor in zip(self.params, factors, strict=True))
        return ColmapCamera(self.model, width, height, params)

    def lens(self, file: str, field: str) -> Lens | None:
        """How its photographs are undistorted; None where it is a pinhole already.

        Raises `CaptureError` naming `file` and `field` where that cannot be, or needs pycolmap.
        """
        try:
            return Lens.of(self.model, self.params, (self.width, self.height), self.distortion)
        except ImportError as error:
            raise CaptureError(
                f"the camera model {self.model} must be undistorted, which needs pycolmap",
                file=file,
                field=field,
                remedy="Install it with `pip install graings[colmap]`, or undistort with `colmap image_undistorter`.",
            ) from error
        except ValueError as error:
            raise CaptureError(
                f"the camera {self.model} {self.params} cannot be undistorted ({error})",
                file=file,
                field=field,
                remedy="Undistort with `colmap image_undistorter` and give its output.",
            ) from error
