"""Transforms: the fields of a transforms file that are read."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter

from graings.capture.capture import Split
from graings.capture.folder import CaptureFolder
from graings.capture.readers.json_document import parse_json
from graings.capture.readers.transforms_camera import Intrinsics
from graings.errors import CaptureError

SINGLE_FILE: Final = "transforms.json"

# Poses written with four digits differ from a rotation by up to this; they are replaced by the nearest rotation.
RIGID_TOLERANCE: Final = 1e-3

Row = Annotated[list[float], Field(min_length=4, max_length=4)]


class FrameEntry(Intrinsics):
    """One frame of the file."""

    file_path: str = Field(min_length=1)
    time: float | None = None
    transform_matrix: Annotated[list[Row], Field(min_length=4, max_length=4)]
    mask_path: str | None = None


class Transforms(Intrinsics):
    """A transforms file."""

    frames: list[FrameEntry]
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    ply_file_path: str | None = None

    def listed(self, split: Split) -> list[str] | None:
        """The file names that the file lists for `split`, or None without a list."""
        return {"train": self.train_filenames, "val": self.val_filenames, "test": self.test_filenames}.get(split)


_TRANSFORMS: Final = TypeAdapter(Transforms)


def parse_transforms(folder: CaptureFolder, file: str) -> Transforms:
    """The transforms file `file`. Raises `CaptureError` naming file and field."""
    return parse_json(_TRANSFORMS, folder.read(file), file)


def world_to_camera(matrix: list[Row], file: str, field: str) -> tuple[NDArray[np.float64], float]:
    """The pose [4, 4] of a `transform_matrix` (camera to world, OpenGL axes), and the scale of its rotation part.

    A uniform scale, which some exporters leave in the matrix, moves no camera and is divided out. Raises `CaptureError`
    naming `file` and `field` for what is no rotation and translation.
    """
    camera_to_world = np.array(matrix, dtype=np.float64)
    camera_to_world[:3, 1:3] *= -1.0  # OpenGL axes to OpenCV's
    left, scales, right = np.linalg.svd(camera_to_world[:3, :3])
    problem = None
    if not np.allclose(camera_to_world[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        problem = f"the last row is {matrix[3]}, not [0, 0, 0, 1]"
    elif scales[2] < 1e-6 * max(scales[0], 1e-300):
        problem = "the rotation part is singular"
    elif scales[0] - scales[2] > 2 * RIGID_TOLERANCE * scales[1]:
        problem = "the rotation part shears or squashes"
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
    return pose, float(scales.mean())


def scale_notes(scales: Iterable[float], file: str) -> list[str]:
    """A note on poses whose rotation part scales."""
    scaled = [scale for scale in scales if abs(scale - 1.0) > RIGID_TOLERANCE]
    if not scaled:
        return []
    return [f"the rotation part of {len(scaled)} poses of {file} scales, by {scaled[0]:.6g}; the scale is left out"]
