"""Reader for transforms files: one per split (D-NeRF, DG-Mesh, NeRF-synthetic) or a single one (nerfstudio, others).

Their poses are camera-to-world with OpenGL axes (y up, z back).
"""

from __future__ import annotations

from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter

from graings.capture.capture import ALL_SPLITS, SPLITS, Split
from graings.capture.folder import CaptureFolder
from graings.capture.raw_capture import RawCapture, RawFrame
from graings.capture.readers.colmap_camera import undistortion_notes
from graings.capture.readers.json_document import parse_json
from graings.capture.readers.ply import read_ply
from graings.capture.readers.transforms_camera import Intrinsics, TransformsCamera
from graings.capture.splits import split_held_out, time_from_name
from graings.config import CaptureConfig
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


def read_transforms(folder: CaptureFolder, config: CaptureConfig) -> RawCapture:
    """The frames of `transforms_{train,val,test,between}.json`. Raises `CaptureError` naming file and field."""
    splits: dict[Split, tuple[RawFrame, ...]] = {split: _read_split(folder, split, config) for split in ALL_SPLITS}
    if not splits["train"]:
        raise CaptureError("has no frames", file=_file("train"), field="frames", remedy="List at least one image.")
    _check_times({_file(split): frames for split, frames in splits.items()})
    notes = undistortion_notes(frame.lens for frames in splits.values() for frame in frames)
    return RawCapture("transforms", splits, (*notes, *_overlap_notes(splits)))


def read_single_transforms(folder: CaptureFolder, config: CaptureConfig) -> RawCapture:
    """The frames of `transforms.json` as nerfstudio, instant-ngp and scanning apps write it.

    Splits are those of `train_filenames`, `val_filenames` and `test_filenames`; without these lists every
    `test_every`-th image by name is held out (`split_held_out`). Points are those of `ply_file_path`. Masks are not
    used. Raises `CaptureError` naming file and field.
    """
    content = parse_json(_TRANSFORMS, folder.read(SINGLE_FILE), SINGLE_FILE)
    listed = _frames(folder, content, SINGLE_FILE, config)
    if not listed:
        raise CaptureError("has no frames", file=SINGLE_FILE, field="frames", remedy="List at least one image.")
    _check_times({SINGLE_FILE: listed})
    notes = undistortion_notes(frame.lens for frame in listed)
    masks = sum(entry.mask_path is not None for entry in content.frames)
    if masks:
        notes.append(f"masks are not used ({masks} frames have one): masked pixels are trained on, too")
    frames = {frame.image.name: frame for frame in sorted(listed, key=lambda frame: frame.image.name)}
    splits = _listed_splits(folder, content, frames, notes)
    if splits is None:
        splits = split_held_out(frames, config.test_every, notes, source=SINGLE_FILE)
    if content.ply_file_path is None:
        return RawCapture("transforms", splits, tuple(notes))
    points = folder.locate(content.ply_file_path, source=SINGLE_FILE, field="ply_file_path")
    name = points.relative_to(folder.root).as_posix()
    return RawCapture.with_points("transforms", splits, notes, *read_ply(name, folder.read(name)))


def _file(split: Split) -> str:
    return f"transforms_{split}.json"


def _read_split(folder: CaptureFolder, split: Split, config: CaptureConfig) -> tuple[RawFrame, ...]:
    file = _file(split)
    if split != "train" and not folder.has(file):
        return ()
    return _frames(folder, parse_json(_TRANSFORMS, folder.read(file), file), file, config)


def _frames(folder: CaptureFolder, content: Transforms, file: str, config: CaptureConfig) -> tuple[RawFrame, ...]:
    """The frames in the order of the file; with `times_from_names` and no times, times are those of the names."""
    frames: list[RawFrame] = []
    indices: dict[str, int] = {}
    cameras = TransformsCamera(content, file)
    times_from_names = config.times_from_names and all(entry.time is None for entry in content.frames)
    for index, entry in enumerate(content.frames):
        field = f"frames[{index}]"
        image = folder.image(entry.file_path, source=file, field=f"{field}.file_path")
        if image.name in indices:
            raise CaptureError(
                f"the image {image.name} is listed twice, first in frames[{indices[image.name]}]",
                file=file,
                field=f"{field}.file_path",
                remedy="Remove one of the entries.",
            )
        indices[image.name] = index
        pose = _world_to_camera(entry.transform_matrix, file, f"{field}.transform_matrix")
        camera, lens = cameras.of(entry, pose, image, field)
        time = time_from_name(image.name) if times_from_names else entry.time
        frames.append(RawFrame(image, camera, time, lens))
    return tuple(frames)


def _listed_splits(
    folder: CaptureFolder, content: Transforms, frames: dict[str, RawFrame], notes: list[str]
) -> dict[Split, tuple[RawFrame, ...]] | None:
    """The splits that the file lists, or None. Without `train_filenames` all frames that are not held out are train."""
    if all(content.listed(split) is None for split in SPLITS):
        return None
    names: dict[Split, set[str]] = {}
    for split in SPLITS:
        names[split] = set()
        for index, listed in enumerate(content.listed(split) or []):
            field = f"{split}_filenames[{index}]"
            name = folder.image(listed, source=SINGLE_FILE, field=field).name
            if name not in frames:
                raise CaptureError(
                    f"{name!r} is no image of frames",
                    file=SINGLE_FILE,
                    field=field,
                    remedy="Correct or remove the name.",
                )
            names[split].add(name)
    held_out = names["val"] | names["test"]
    if content.train_filenames is None:
        names["train"] = set(frames) - held_out
    if not names["train"]:
        raise CaptureError(
            "leaves no training image", file=SINGLE_FILE, field="train_filenames", remedy="Hold fewer images out."
        )
    splits = {split: tuple(frames[name] for name in frames if name in names[split]) for split in SPLITS}
    notes += _overlap_notes(splits)
    unlisted = len(set(frames) - names["train"] - held_out)
    if unlisted:
        notes.append(f"{unlisted} images that no split lists are not used")
    return splits


def _overlap_notes(splits: dict[Split, tuple[RawFrame, ...]]) -> list[str]:
    """A note for each held-out split that shares images with the training split."""
    trained = {frame.image.name for frame in splits["train"]}
    counts = {
        split: sum(frame.image.name in trained for frame in frames)
        for split, frames in splits.items()
        if split != "train"
    }
    return [
        f"{count} of {len(splits[split])} {split} images are also training images"
        for split, count in counts.items()
        if count
    ]


def _world_to_camera(matrix: list[Row], file: str, field: str) -> NDArray[np.float64]:
    camera_to_world = np.array(matrix, dtype=np.float64)
    camera_to_world[:3, 1:3] *= -1.0  # OpenGL axes to OpenCV's
    left, scales, right = np.linalg.svd(camera_to_world[:3, :3])
    problem = None
    if not np.allclose(camera_to_world[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        problem = f"the last row is {matrix[3]}, not [0, 0, 0, 1]"
    elif scales[2] < 1e-6 * max(scales[0], 1e-300):
        problem = "the rotation part is singular"
    elif np.abs(scales - 1.0).max() > RIGID_TOLERANCE:
        uniform = scales[0] - scales[2] < RIGID_TOLERANCE * scales[0]
        problem = f"the rotation part scales by {scales[0]:.6g}" if uniform else "the rotation part shears or squashes"
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


def _check_times(files: dict[str, tuple[RawFrame, ...]]) -> None:
    timed = any(frame.time is not None for frames in files.values() for frame in frames)
    for file, frames in files.items():
        for index, frame in enumerate(frames):
            if timed and frame.time is None:
                raise CaptureError(
                    "the time is missing here but given for other frames",
                    file=file,
                    field=f"frames[{index}].time",
                    remedy="Give every frame a time, or none of them (static scene).",
                )
