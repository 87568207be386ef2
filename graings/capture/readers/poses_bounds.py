"""Reader for `poses_bounds.npy` of LLFF and Neural-3D-Video: one pose per image, or per camera of a rig.

Each row is a matrix [3, 5] and two depths. Its columns are the camera's down, right and backward axis, its centre, and
(height, width, focal length). Rows belong to the files of `images/`, or to the cameras, in the order of their names.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.capture.folder import CaptureFolder
from graings.capture.image_file import ImageFile
from graings.capture.number_in_name import notes_on_points
from graings.capture.orientation import image_scale, named_size, oriented
from graings.capture.raw_capture import RawCapture, RawFrame
from graings.capture.readers.array_file import read_array
from graings.capture.readers.colmap_camera import ColmapCamera, UndistortedCameras
from graings.capture.readers.rig import VIDEO_SUFFIXES
from graings.capture.splits import split_held_out, time_from_name
from graings.config import CaptureConfig
from graings.errors import CaptureError

FILE: Final = "poses_bounds.npy"
IMAGE_FOLDERS: Final = ("images", "images_2", "images_4", "images_8", ".")

RIGID_TOLERANCE: Final = 1e-3


def read_poses_bounds(folder: CaptureFolder, config: CaptureConfig) -> RawCapture:
    """The images, or the frames of the folders of a rig (`cam00/`, …). Raises `CaptureError` naming the file."""
    rows = read_array(folder, FILE, columns=17)
    cameras = UndistortedCameras(FILE)
    frames: dict[str, RawFrame] = {}
    sources, is_rig = _sources(folder, len(rows), config.rig)
    timed = is_rig or config.times_from_names
    for index, (row, files) in enumerate(zip(rows, sources, strict=True)):
        pose, (height, width, focal) = _pose(row, index)
        for file in files:
            image = oriented(folder.image(file, source=FILE), width, height, config.orientation)
            camera = _camera(image, width, height, focal, index)
            frames[image.name] = RawFrame(
                image,
                cameras.of(camera, pose, f"row {index}")[0],
                time_from_name(image.name) if timed else None,
            )
    notes = [f"{FILE} says nothing about distortion: the images are used as they are"]
    if is_rig:
        notes.append(f"a rig of {len(rows)} cameras with a folder of frames each; numbers in file names are times")
    if timed:
        notes += notes_on_points(list(frames))
    splits = split_held_out(frames, config.test_every, notes, source=FILE)
    return RawCapture("llff", splits, tuple(notes))


def _sources(folder: CaptureFolder, count: int, rig: bool) -> tuple[list[list[str]], bool]:
    """The files of each row, and whether the rows are cameras with several frames each, as they must be with `rig`."""
    found = []
    for place in IMAGE_FOLDERS:
        images = folder.pictures(place)
        found.append(f"{len(images)} in {place}")
        if len(images) == count and not rig:
            return [[image] for image in images], False
    for place in (".", "images"):
        root = folder.root / place
        inner = sorted(path.name for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
        if count > 1:  # the calibrated pictures of several cameras are not the frames of one
            inner = [name for name in inner if name not in IMAGE_FOLDERS]
        frames = [files for files in (_frames(folder, str(Path(place, name))) for name in inner) if len(files) > 1]
        if len(frames) == count:
            return frames, True
    clips = sorted(path.name for path in folder.root.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES)
    if clips:
        stem = Path(clips[0]).stem
        raise CaptureError(
            f"gives {count} poses for the videos {clips[0]}, …, whose frames are not extracted",
            file=FILE,
            remedy="Extract the frames of each into a folder of its name, for example with "
            f"`mkdir {stem}; ffmpeg -i {clips[0]} {stem}/%05d.png`.",
        )
    raise CaptureError(
        f"gives {count} poses, but there are {', '.join(found)} pictures and no {count} folders of frames",
        file=FILE,
        remedy="Give one picture, or one folder of frames, for each pose.",
    )


def _frames(folder: CaptureFolder, place: str) -> list[str]:
    """The frames of one camera, which Neural-3D-Video keeps in `images/` of its folder."""
    return folder.pictures(place) or folder.pictures(f"{place}/images")


def _pose(row: NDArray[np.float64], index: int) -> tuple[NDArray[np.float64], tuple[float, float, float]]:
    """World to camera [4, 4] with OpenCV's axes, and (height, width, focal length) in px."""
    matrix = row[:15].reshape(3, 5)
    down, right, back = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    rotation = np.stack([right, down, -back])
    height, width, focal = (float(value) for value in matrix[:, 4])
    left, scales, other = np.linalg.svd(rotation) if np.isfinite(row).all() else (np.eye(3), np.zeros(3), np.eye(3))
    if np.abs(scales - 1.0).max() > RIGID_TOLERANCE or np.linalg.det(rotation) < 0 or min(height, width, focal) <= 0:
        raise CaptureError(
            "is no pose (down, right, back, centre and height, width, focal length)",
            file=FILE,
            field=f"row {index}",
            remedy="Export the poses again.",
        )
    pose = np.eye(4)
    pose[:3, :3] = left @ other
    pose[:3, 3] = -pose[:3, :3] @ matrix[:, 3]
    return pose, (height, width, focal)


def _camera(image: ImageFile, width: float, height: float, focal: float, index: int) -> ColmapCamera:
    scale = image_scale(image, width, height)
    if scale is None:
        raise CaptureError(
            f"is for {width:g}x{height:g} px, the image {image.name} has {named_size(image)}",
            file=FILE,
            field=f"row {index}",
            remedy="Give the images from which the poses were made.",
        )
    sx, sy = scale
    params = (focal * sx, focal * sy, 0.5 * image.width, 0.5 * image.height)
    return ColmapCamera("PINHOLE", image.width, image.height, params)
