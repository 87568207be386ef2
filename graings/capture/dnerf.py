"""Reader for `transforms_{train,val,test}.json`: D-NeRF, DG-Mesh, NeRF-synthetic and relatives.

Poses there are camera-to-world with OpenGL axes (y up, z back). Knows nothing of pixels or of normalised units.
"""

from __future__ import annotations

import math
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from graings.camera import Camera
from graings.capture.capture import SPLITS, Split
from graings.capture.folder import CaptureFolder
from graings.capture.image_file import ImageFile
from graings.capture.json_document import parse_json
from graings.capture.recording import Recording, Shot
from graings.errors import CaptureError

# Poses printed with four digits are this far from a rotation; the nearest rotation replaces them.
RIGID_TOLERANCE: Final = 1e-3

Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Angle = Annotated[float, Field(gt=0, lt=math.pi)]
Length = Annotated[float, Field(gt=0)]


class Intrinsics(BaseModel):
    """Keys that may stand at the top of the file or in a frame, where they win."""

    # Other programs add keys of their own; those that bend the picture are named here to be refused.
    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)

    camera_angle_x: Angle | None = None
    camera_angle_y: Angle | None = None
    fl_x: Length | None = None
    fl_y: Length | None = None
    cx: float | None = None
    cy: float | None = None
    w: Length | None = None
    h: Length | None = None
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def has_focal(self) -> bool:
        """Whether a focal length is given in any form."""
        return self.fl_x is not None or self.camera_angle_x is not None


class Entry(Intrinsics):
    """One frame of the file."""

    file_path: str = Field(min_length=1)
    time: float | None = None
    transform_matrix: Annotated[list[Row], Field(min_length=4, max_length=4)]


class Transforms(Intrinsics):
    """One file."""

    frames: list[Entry]


_TRANSFORMS: Final = TypeAdapter(Transforms)


def read_transforms(folder: CaptureFolder) -> Recording:
    """Everything the three files say. Raises `CaptureError` naming file and field."""
    splits: dict[Split, tuple[Shot, ...]] = {split: _read_split(folder, split) for split in SPLITS}
    if not splits["train"]:
        raise CaptureError("has no frames", file=_file("train"), field="frames", remedy="List at least one image.")
    _check_times(splits)
    notes: list[str] = []
    trained = {shot.image.name for shot in splits["train"]}
    for split in SPLITS[1:]:
        shared = sum(shot.image.name in trained for shot in splits[split])
        if shared:
            notes.append(f"{shared} of {len(splits[split])} {split} images are training images too")
    return Recording("transforms", splits, tuple(notes))


def _file(split: Split) -> str:
    return f"transforms_{split}.json"


def _read_split(folder: CaptureFolder, split: Split) -> tuple[Shot, ...]:
    file = _file(split)
    if split != "train" and not folder.has(file):
        return ()
    content = parse_json(_TRANSFORMS, folder.read(file), file)
    shots: list[Shot] = []
    first: dict[str, int] = {}
    for index, entry in enumerate(content.frames):
        where = f"frames[{index}]"
        image = folder.image(entry.file_path, source=file, field=f"{where}.file_path")
        if image.name in first:
            raise CaptureError(
                f"the image {image.name} is listed twice, first in frames[{first[image.name]}]",
                file=file,
                field=f"{where}.file_path",
                remedy="Take one of the entries out.",
            )
        first[image.name] = index
        pose = _world_to_camera(entry.transform_matrix, file, f"{where}.transform_matrix")
        shots.append(Shot(image, _camera(pose, entry, content, image, file, where), entry.time))
    return tuple(shots)


def _world_to_camera(matrix: list[Row], file: str, field: str) -> NDArray[np.float64]:
    camera_to_world = np.array(matrix, dtype=np.float64)
    camera_to_world[:3, 1:3] *= -1.0  # OpenGL axes to OpenCV's
    left, stretch, right = np.linalg.svd(camera_to_world[:3, :3])
    problem = None
    if not np.allclose(camera_to_world[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        problem = f"the last row is {matrix[3]}, not [0, 0, 0, 1]"
    elif stretch[2] < 1e-6 * max(stretch[0], 1e-300):
        problem = "the rotation part is singular"
    elif np.abs(stretch - 1.0).max() > RIGID_TOLERANCE:
        uniform = stretch[0] - stretch[2] < RIGID_TOLERANCE * stretch[0]
        problem = f"the rotation part scales by {stretch[0]:.6g}" if uniform else "the rotation part shears or squashes"
    elif np.linalg.det(left @ right) < 0:
        problem = "the rotation part mirrors"
    if problem is not None:
        raise CaptureError(
            f"{problem}; a camera pose is a rotation and a translation",
            file=file,
            field=field,
            remedy="Export rigid camera-to-world matrices.",
        )
    rotation = (left @ right).T
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ camera_to_world[:3, 3]
    return pose


def _camera(
    pose: NDArray[np.float64], entry: Entry, content: Transforms, image: ImageFile, file: str, where: str
) -> Camera:
    bent = [key for key in ("k1", "k2", "k3", "k4", "p1", "p2") if getattr(entry, key) or getattr(content, key)]
    if bent:
        raise CaptureError(
            f"lens distortion ({', '.join(bent)}) is not undistorted by this reader",
            file=file,
            field=bent[0],
            remedy="Undistort the images first, or give the COLMAP folder instead.",
        )
    focal = entry if entry.has_focal() else content
    if not focal.has_focal():
        raise CaptureError(
            "no focal length: neither camera_angle_x nor fl_x is given",
            file=file,
            field=where,
            remedy="Add one of them to the frame or to the top of the file.",
        )
    sx, sy = _scale(entry, content, image, file, where)
    if focal.fl_x is not None:
        fx = focal.fl_x * sx
        fy = (focal.fl_y if focal.fl_y is not None else focal.fl_x) * sy
    else:
        assert focal.camera_angle_x is not None  # has_focal
        fx = 0.5 * image.width / math.tan(0.5 * focal.camera_angle_x)
        angle_y = focal.camera_angle_y
        fy = fx if angle_y is None else 0.5 * image.height / math.tan(0.5 * angle_y)
    cx = entry.cx if entry.cx is not None else content.cx
    cy = entry.cy if entry.cy is not None else content.cy
    cx = 0.5 * image.width if cx is None else cx * sx
    cy = 0.5 * image.height if cy is None else cy * sy
    try:
        return Camera(pose, fx, fy, cx, cy, image.width, image.height)
    except ValueError as error:  # such as a product beyond all numbers
        raise CaptureError(str(error), file=file, field=where, remedy="Mend the camera there.") from error


def _scale(entry: Entry, content: Transforms, image: ImageFile, file: str, where: str) -> tuple[float, float]:
    """Size of the file over the size its intrinsics are given for."""
    width = entry.w if entry.w is not None else content.w
    height = entry.h if entry.h is not None else content.h
    sx = 1.0 if width is None else image.width / width
    sy = 1.0 if height is None else image.height / height
    # A file scaled down may have lost up to a pixel of its shorter side to rounding.
    if abs(sx - sy) * min(width or image.width, height or image.height) > 1.0:
        raise CaptureError(
            f"the intrinsics are for {width:g}x{height:g} px, the image {image.name} has {image.width}x{image.height}"
            if width is not None and height is not None
            else f"one of w and h is missing and the other differs from the image {image.name}",
            file=file,
            field=f"{where}.w, h",
            remedy="Give w and h of the images as they are, or images of the same shape.",
        )
    return sx, sy


def _check_times(splits: dict[Split, tuple[Shot, ...]]) -> None:
    everywhere = any(shot.time is not None for shots in splits.values() for shot in shots)
    for split, shots in splits.items():
        for index, shot in enumerate(shots):
            if everywhere and shot.time is None:
                raise CaptureError(
                    "the time is missing here but given for other frames",
                    file=_file(split),
                    field=f"frames[{index}].time",
                    remedy="Give every frame a time, or none of them (static scene).",
                )
