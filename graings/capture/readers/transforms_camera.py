"""TransformsCamera: cameras of undistorted images from the intrinsics of a transforms file."""

from __future__ import annotations

import math
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from graings.camera.camera import Camera
from graings.capture.image_file import ImageFile
from graings.capture.lens import Lens
from graings.capture.orientation import Orientation, image_scale, named_size, oriented
from graings.capture.readers.colmap_camera import (
    PANORAMA_REMEDY,
    ColmapCamera,
    UndistortedCameras,
    panorama_problem,
)
from graings.errors import CaptureError

Angle = Annotated[float, Field(ge=1e-6, lt=math.pi)]
Length = Annotated[float, Field(gt=0)]
Coefficient = Literal["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "sx1", "sy1", "omega"]

# Camera models of nerfstudio and COLMAP. The coefficients define the distortion, so all perspective models are
# equivalent, and all fisheye models without tangential distortion.
RATIONAL: Final = "FULL_OPENCV"
PERSPECTIVE: Final = frozenset(
    ("OPENCV", RATIONAL, "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
)
THIN_PRISM: Final = "THIN_PRISM_FISHEYE"
FISHEYE: Final = frozenset(("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", THIN_PRISM))
FIELD_OF_VIEW: Final = "FOV"
# Names of pictures that show all directions.
PANORAMIC: Final = frozenset(
    (
        *("EQUIRECTANGULAR", "SPHERICAL", "PANORAMA"),
        *("OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R", "VR180_L", "VR180_R"),
    )
)


class Intrinsics(BaseModel):
    """Intrinsics at the top of the file or in a frame; those of the frame take precedence."""

    # Other programs add keys of their own. All keys of distortion are declared here, so that none is ignored silently.
    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)

    camera_model: str | None = None
    is_fisheye: bool | None = None
    camera_angle_x: Angle | None = None
    camera_angle_y: Angle | None = None
    fl_x: Length | None = None
    fl_y: Length | None = None
    cx: float | None = None
    cy: float | None = None
    w: Length | None = None
    h: Length | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    k5: float | None = None
    k6: float | None = None
    p1: float | None = None
    p2: float | None = None
    sx1: float | None = None
    sy1: float | None = None
    omega: float | None = None

    def has_focal(self) -> bool:
        """Whether a focal length is given in any form."""
        return self.fl_x is not None or self.camera_angle_x is not None


class TransformsCamera:
    """Cameras of one file, whose intrinsics at the `top` apply to frames without their own."""

    def __init__(self, top: Intrinsics, file: str, orientation: Orientation = "auto") -> None:
        self.top, self.file, self.orientation = top, file, orientation
        self._undistorted = UndistortedCameras(file)

    def of(
        self, frame: Intrinsics, world_to_camera: NDArray[np.float64], image: ImageFile, field: str
    ) -> tuple[ImageFile, Camera, Lens | None]:
        """`image` as stored or turned; camera of the undistorted one, with the pose `world_to_camera` [4, 4]; its lens.

        Raises `CaptureError` naming the file and `field`.
        """
        image = oriented(image, *self._size(frame), self.orientation)
        return image, *self._undistorted.of(self._distorted(frame, image, field), world_to_camera, field)

    def _distorted(self, frame: Intrinsics, image: ImageFile, field: str) -> ColmapCamera:
        """The camera of the distorted `image` as one of COLMAP's models."""
        name = frame.camera_model or self.top.camera_model
        fisheye = name in FISHEYE or bool(frame.is_fisheye or (frame.is_fisheye is None and self.top.is_fisheye))
        pinhole = self._pinhole(frame, image, field)
        k1, k2, k3, k4, k5, k6 = (self._coefficient(frame, key) for key in ("k1", "k2", "k3", "k4", "k5", "k6"))
        p1, p2, sx1, sy1 = (self._coefficient(frame, key) for key in ("p1", "p2", "sx1", "sy1"))
        problem, remedy = None, "Undistort the images first, or give the COLMAP folder instead."
        if name is not None and name.upper() in PANORAMIC:
            problem, remedy = panorama_problem(name), PANORAMA_REMEDY
        elif name is not None and name not in PERSPECTIVE | FISHEYE | {FIELD_OF_VIEW}:
            problem = f"the camera model {name} is not supported"
        elif fisheye and name != THIN_PRISM and any((p1, p2, sx1, sy1)):
            problem = "a fisheye lens with tangential distortion (p1, p2) is not supported"
        elif not fisheye and name != RATIONAL and any((k4, k5, k6)):
            problem = "a fourth radial coefficient (k4) is not supported"  # programs differ in what it means
        if problem is not None:
            raise CaptureError(problem, file=self.file, field=field, remedy=remedy)
        distortion: tuple[float, ...]
        if name == FIELD_OF_VIEW:
            model, distortion = "FOV", (self._coefficient(frame, "omega"),)
        elif name == THIN_PRISM:
            model, distortion = "THIN_PRISM_FISHEYE", (k1, k2, p1, p2, k3, k4, sx1, sy1)
        elif fisheye:
            model, distortion = "OPENCV_FISHEYE", (k1, k2, k3, k4)
        elif k3 or name == RATIONAL:
            model, distortion = "FULL_OPENCV", (k1, k2, p1, p2, k3, k4, k5, k6)
        else:
            model, distortion = "OPENCV", (k1, k2, p1, p2)
        return ColmapCamera(model, image.width, image.height, (*pinhole, *distortion))

    def _coefficient(self, frame: Intrinsics, key: Coefficient) -> float:
        own, shared = getattr(frame, key), getattr(self.top, key)
        return float(own if own is not None else shared if shared is not None else 0.0)

    def _pinhole(self, frame: Intrinsics, image: ImageFile, field: str) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy in px of `image`."""
        focal = frame if frame.has_focal() else self.top
        if not focal.has_focal():
            raise CaptureError(
                "no focal length: neither camera_angle_x nor fl_x is given",
                file=self.file,
                field=field,
                remedy="Add one of them to the frame or to the top of the file.",
            )
        sx, sy = self._scale(frame, image, field)
        if focal.fl_x is not None:
            fx = focal.fl_x * sx
            fy = (focal.fl_y if focal.fl_y is not None else focal.fl_x) * sy
        else:
            assert focal.camera_angle_x is not None  # as has_focal is true
            fx = 0.5 * image.width / math.tan(0.5 * focal.camera_angle_x)
            angle_y = focal.camera_angle_y
            fy = fx if angle_y is None else 0.5 * image.height / math.tan(0.5 * angle_y)
        cx = frame.cx if frame.cx is not None else self.top.cx
        cy = frame.cy if frame.cy is not None else self.top.cy
        return fx, fy, 0.5 * image.width if cx is None else cx * sx, 0.5 * image.height if cy is None else cy * sy

    def _size(self, frame: Intrinsics) -> tuple[float | None, float | None]:
        """Width and height in px for which the intrinsics of `frame` are given, as far as the file says."""
        return (
            frame.w if frame.w is not None else self.top.w,
            frame.h if frame.h is not None else self.top.h,
        )

    def _scale(self, frame: Intrinsics, image: ImageFile, field: str) -> tuple[float, float]:
        """Size of `image` over the size for which its intrinsics are given."""
        width, height = self._size(frame)
        scale = image_scale(image, width or image.width, height or image.height)
        if scale is None:
            raise CaptureError(
                f"the intrinsics are for {width:g}x{height:g} px, the image {image.name} has {named_size(image)}"
                if width is not None and height is not None
                else f"one of w and h is missing and the other differs from the image {image.name}",
                file=self.file,
                field=f"{field}.w, h",
                remedy="Give w and h of the image files, or images of the same aspect ratio.",
            )
        return scale
