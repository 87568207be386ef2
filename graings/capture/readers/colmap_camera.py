"""ColmapCamera: intrinsics in COLMAP's camera models, which all readers convert to undistorted cameras.

The checks that are common to all formats are here, too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.lens import Lens
from graings.colmap import pycolmap_has_a_build, pycolmap_remedy
from graings.errors import CaptureError

# By the id in cameras.bin: name, number of parameters, number of focal lengths, which come first (cx, cy follow).
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
# Models that show all directions.
PANORAMIC_MODELS: Final[dict[int, str]] = {17: "EQUIRECTANGULAR"}
PANORAMA_REMEDY: Final = (
    "Cut each picture into perspective views with poses of their own, for example with `ns-process-data "
    "images --camera-type equirectangular` or COLMAP's script panorama_sfm."
)
UNDISTORTER: Final = "colmap image_undistorter"
MODELS: Final = {name: (count, focals) for name, count, focals in CAMERA_MODELS.values()}


@dataclass(frozen=True, slots=True)
class ColmapCamera:
    """A distorted camera; `params` are focal lengths, principal point and distortion, in px where lengths."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy in px, without the distortion."""
        focals = MODELS[self.model][1]
        cx, cy = self.params[focals : focals + 2]
        return self.params[0], self.params[focals - 1], cx, cy

    @property
    def distortion(self) -> tuple[float, ...]:
        """The parameters after the principal point."""
        return self.params[MODELS[self.model][1] + 2 :]

    def scaled(self, width: int, height: int) -> ColmapCamera:
        """The same camera for images of another size with the same aspect ratio."""
        sx, sy = width / self.width, height / self.height
        focals = MODELS[self.model][1]
        factors = ([sx] if focals == 1 else [sx, sy]) + [sx, sy] + [1.0] * len(self.distortion)
        params = tuple(value * factor for value, factor in zip(self.params, factors, strict=True))
        return ColmapCamera(self.model, width, height, params)

    def lens(self, file: str, field: str) -> Lens | None:
        """The lens that undistorts its images; None where it is a pinhole already.

        Raises `CaptureError` naming `file` and `field` where this is impossible or requires pycolmap.
        """
        try:
            return Lens.of(self.model, self.params, (self.width, self.height), self.distortion)
        except ImportError as error:
            remedy = f"Undistort with `{UNDISTORTER}`: {pycolmap_remedy()}."
            if pycolmap_has_a_build():
                remedy = f"Install it with `{pycolmap_remedy()}`, or undistort with `{UNDISTORTER}`."
            raise CaptureError(
                f"the camera model {self.model} must be undistorted, which needs pycolmap",
                file=file,
                field=field,
                remedy=remedy,
            ) from error
        except ValueError as error:
            raise CaptureError(
                f"the camera {self.model} {self.params} cannot be undistorted ({error})",
                file=file,
                field=field,
                remedy=f"Undistort with `{UNDISTORTER}` and give its output.",
            ) from error


def panorama_problem(model: str) -> str:
    """Why pictures of a panoramic `model` are refused."""
    return f"pictures of the camera model {model} show all directions, which no single perspective view can"


class UndistortedCameras:
    """Undistorted cameras of the images in `file`; images with the same distorted camera share its lens."""

    def __init__(self, file: str) -> None:
        self.file = file
        self._lenses: dict[ColmapCamera, Lens | None] = {}

    def of(
        self, distorted: ColmapCamera, world_to_camera: NDArray[np.float64], field: str
    ) -> tuple[Camera, Lens | None]:
        """The camera of an undistorted image with the pose `world_to_camera` [4, 4], and the lens that undistorts it.

        Raises `CaptureError` naming the file and `field`.
        """
        if distorted not in self._lenses:
            self._lenses[distorted] = distorted.lens(self.file, field)
        lens = self._lenses[distorted]
        pinhole, size = distorted.pinhole, (distorted.width, distorted.height)
        if lens is not None:
            pinhole, size = lens.pinhole, lens.pinhole_size
        try:
            return Camera(world_to_camera, *pinhole, *size), lens
        except ValueError as error:  # for example a focal length that overflows
            raise CaptureError(str(error), file=self.file, field=field, remedy="Correct the camera there.") from error


def undistortion_notes(lenses: Iterable[Lens | None]) -> list[str]:
    """A note that names the camera models that are undistorted; none if there are none."""
    models = sorted({lens.model for lens in lenses if lens is not None})
    return [f"images are undistorted when decoded ({', '.join(models)})"] if models else []
