"""Reader for transforms files: one for each split (D-NeRF, DG-Mesh, NeRF-synthetic) or one alone (nerfstudio, others).

Poses there are camera-to-world with OpenGL axes (y up, z back). Knows nothing of pixels or of normalised units.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter

from graings.capture.capture import ALL_SPLITS, SPLITS, Split
from graings.capture.folder import CaptureFolder
from graings.capture.raw_capture import RawCapture, RawFrame
from graings.capture.readers.json_document import parse_json
from graings.capture.readers.ply import read_ply
from graings.capture.readers.transforms_camera import Intrinsics, TransformsCamera
from graings.capture.splits import split_held_out, time_from_name
from graings.config import CaptureConfig
from graings.errors import CaptureError

SINGLE_FILE: Final = "transforms.json"

# Poses printed with four digits are this far from a rotation; the nearest rotation replaces them.
RIGID_TOLERANCE: Final = 1e-3

Row = Annotated[list[float], Field(min_length=4, max_length=4)]


class Entry(Intrinsics):
    """One frame of the file."""

    file_path: str = Field(min_length=1)
    time: float | None = None
    transform_matrix: Annotated[list[Row], Field(min_length=4, max_length=4)]
    mask_path: str | None = None


class Transforms(Intrinsics):
    """One file."""

    frames: list[Entry]
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    ply_file_path: str | None = None

    def listed(self, split: Split) -> list[str] | None:
        """The images that the file names for `split`, or None where it does not."""
        return {"train": self.train_filenames, "val": self.val_filenames, "test": self.test_filenames}.get(split)


_TRANSFORMS: Final = TypeAdapter(Transforms)


def read_transforms(folder: CaptureFolder, config: CaptureConfig) -> RawCapture:
    """Everything `transforms_{train,val,test,between}.json` say. Raises `CaptureError` naming file and field."""
    splits: dict[Split, tuple[RawFrame, ...]] = {split: _read_split(folder, split, config) for split in ALL_SPLITS}
    if not splits["train"]:
        raise CaptureError("has no frames", file=_file("train"), field="frames", remedy="List at least one image.")
    _check_times({_file(split): shots for split, shots in splits.items()})
    notes = _lens_notes(shot for shots in splits.values() for shot in shots)
    trained = {shot.image.name for shot in splits["train"]}
    for split in ALL_SPLITS[1:]:
        shared = sum(shot.image.name in trained for shot in splits[split])
        if shared:
            notes.append(f"{shared} of {len(splits[split])} {split} images are training images too")
    return RawCapture("transforms", splits, tuple(notes))


def read_single_transforms(folder: CaptureFolder, config: CaptureConfig) -> RawCapture:
    """Everything `transforms.json` says, as nerfstudio, instant-ngp and scanning apps write it.

    Splits are those of `train_filenames`, `val_filenames` and `test_filenames`; where there are none every
    `test_every`-th image by name is held out as of a COLMAP model. Points are those of `ply_file_path`. Masks are not
    used. Raises `CaptureError` naming file and field.
    """
    content = parse_json(_TRANSFORMS, folder.read(SINGLE_FILE), SINGLE_FILE)
    taken = _shots(folder, content, SINGLE_FILE, config)
    if not taken:
        raise CaptureError("has no frames", file=SINGLE_FILE, field="frames", remedy="List at least one image.")
    _check_times({SINGLE_FILE: taken})
    notes = _lens_notes(taken)
    masks = sum(entry.mask_path is not None for entry in content.frames)
    if masks:
        notes.append(f"masks are not used ({masks} frames name one): what they hide is trained on")
    shots = {shot.image.name: shot for shot in sorted(taken, key=lambda shot: shot.image.name)}
    splits = _listed_splits(folder, content, shots, notes)
    if splits is None:
        splits = split_held_out(shots, config.test_every, notes, source=SINGLE_FILE)
    if content.ply_file_path is None:
        return RawCapture("transforms", splits, tuple(notes))
    cloud = folder.locate(content.ply_file_path, source=SINGLE_FILE, field="ply_file_path")
    name = cloud.relative_to(folder.root).as_posix()
    return RawCapture.with_points("transforms", splits, notes, *read_ply(name, folder.read(name)))


def _file(split: Split) -> str:
    return f"transforms_{split}.json"


def _read_split(folder: CaptureFolder, split: Split, config: CaptureConfig) -> tuple[RawFrame, ...]:
    file = _file(split)
    if split != "train" and not folder.has(file):
        return ()
    return _shots(folder, parse_json(_TRANSFORMS, folder.read(file), file), file, config)


def _shots(folder: CaptureFolder, content: Transforms, file: str, config: CaptureConfig) -> tuple[RawFrame, ...]:
    """The frames in the order of the file; times are those of names where asked for and none is given."""
    shots: list[RawFrame] = []
    first: dict[str, int] = {}
    cameras = TransformsCamera(content, file)
    by_name = config.times_from_names and all(entry.time is None for entry in content.frames)
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
        camera, lens = cameras.of(entry, pose, image, where)
        time = time_from_name(image.name) if by_name else entry.time
        shots.append(RawFrame(image, camera, time, lens))
    return tuple(shots)


def _listed_splits(
    folder: CaptureFolder, content: Transforms, shots: dict[str, RawFrame], notes: list[str]
) -> dict[Split, tuple[RawFrame, ...]] | None:
    """The splits that the file lists; None where it lists none. What it does not list is trained on."""
    if all(content.listed(split) is None for split in SPLITS):
        return None
    named: dict[Split, list[str]] = {}
    for split in SPLITS:
        field = f"{split}_filenames"
        named[split] = [
            folder.image(name, source=SINGLE_FILE, field=f"{field}[{index}]").name
            for index, name in enumerate(content.listed(split) or [])
        ]
        for index, name in enumerate(named[split]):
            if name not in shots:
                raise CaptureError(
                    f"{name!r} is no image of frames",
                    file=SINGLE_FILE,
                    field=f"{field}[{index}]",
                    remedy="Correct the name or take it out.",
                )
    held_out = {*named["val"], *named["test"]}
    trained = set(named["train"]) if content.train_filenames is not None else set(shots) - held_out
    for split in SPLITS[1:]:
        shared = len(trained & set(named[split]))
        if shared:
            notes.append(f"{shared} of {len(set(named[split]))} {split} images are training images too")
    left_out = len(set(shots) - trained - held_out)
    if left_out:
        notes.append(f"{left_out} images that no split lists are left out")
    if not trained:
        raise CaptureError(
            "leaves no training image", file=SINGLE_FILE, field="train_filenames", remedy="Hold fewer images out."
        )
    groups: dict[Split, set[str]] = {"train": trained, "val": set(named["val"]), "test": set(named["test"])}
    return {split: tuple(shots[name] for name in shots if name in group) for split, group in groups.items()}


def _lens_notes(shots: Iterable[RawFrame]) -> list[str]:
    models = sorted({shot.lens.model for shot in shots if shot.lens is not None})
    return [f"images are undistorted when decoded ({', '.join(models)})"] if models else []


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


def _check_times(files: dict[str, tuple[RawFrame, ...]]) -> None:
    everywhere = any(shot.time is not None for shots in files.values() for shot in shots)
    for file, shots in files.items():
        for index, shot in enumerate(shots):
            if everywhere and shot.time is None:
                raise CaptureError(
                    "the time is missing here but given for other frames",
                    file=file,
                    field=f"frames[{index}].time",
                    remedy="Give every frame a time, or none of them (static scene).",
                )
