"""Reader for transforms files: one per split (D-NeRF, DG-Mesh, NeRF-synthetic) or a single one (nerfstudio, others).

Their poses are camera-to-world with OpenGL axes (y up, z back).
"""

from __future__ import annotations

from graings.capture.capture import ALL_SPLITS, SPLITS, Split
from graings.capture.folder import CaptureFolder
from graings.capture.listed_images import ListedImages
from graings.capture.number_in_name import notes_on_points
from graings.capture.raw_capture import RawCapture, RawFrame
from graings.capture.readers.colmap_camera import undistortion_notes
from graings.capture.readers.ply import read_ply
from graings.capture.readers.rig import RigFrames, with_rig
from graings.capture.readers.transforms_camera import TransformsCamera
from graings.capture.readers.transforms_document import (
    SINGLE_FILE,
    Transforms,
    parse_transforms,
    scale_notes,
    world_to_camera,
)
from graings.capture.splits import split_held_out, time_from_name
from graings.config import CaptureConfig
from graings.errors import CaptureError


def split_file(split: Split) -> str:
    """The transforms file of one split."""
    return f"transforms_{split}.json"


def read_transforms(folder: CaptureFolder, config: CaptureConfig) -> RawCapture:
    """The frames of `transforms_{train,val,test,between}.json`. Raises `CaptureError` naming file and field.

    A held-out split of which no image is on disk is left out. Where only the training file remains, it is read as
    `read_single_transforms` does; a file without frames says that no image is to be held out. Points are those of its
    `ply_file_path`.
    """
    notes: list[str] = []
    content = parse_transforms(folder, split_file("train"))
    train = _frames(folder, content, split_file("train"), config, notes)
    if not train:
        raise CaptureError("has no frames", file=split_file("train"), field="frames", remedy="List at least one image.")
    splits: dict[Split, tuple[RawFrame, ...]] = {"train": train}
    left_out = False
    for split in ALL_SPLITS:
        if split != "train" and folder.has(split_file(split)):
            listed = parse_transforms(folder, split_file(split))
            splits[split] = _frames(folder, listed, split_file(split), config, notes, optional=True)
            left_out = left_out or (bool(listed.frames) and not splits[split])
    _check_times({split_file(split): frames for split, frames in splits.items()})
    lone = len(splits) == 1 or (left_out and not any(splits[split] for split in splits if split != "train"))
    if lone:
        return _split(folder, content, train, split_file("train"), config, notes)
    if config.rig:
        rigs = {split: with_rig(folder, _by_name(frames), config, notes) for split, frames in splits.items()}
        splits = {split: tuple(rig.frames.values()) for split, rig in rigs.items()}
    notes += undistortion_notes(frame.lens for frames in splits.values() for frame in frames)
    return _with_points(folder, content, splits, split_file("train"), [*notes, *_overlap_notes(splits)])


def read_single_transforms(folder: CaptureFolder, config: CaptureConfig) -> RawCapture:
    """The frames of `transforms.json` as nerfstudio, instant-ngp and scanning apps write it.

    Splits are those of `train_filenames`, `val_filenames` and `test_filenames`; without these lists every
    `test_every`-th image by name is held out (`split_held_out`). Points are those of `ply_file_path`. Raises
    `CaptureError` naming file and field.
    """
    notes: list[str] = []
    content = parse_transforms(folder, SINGLE_FILE)
    listed = _frames(folder, content, SINGLE_FILE, config, notes)
    if not listed:
        raise CaptureError("has no frames", file=SINGLE_FILE, field="frames", remedy="List at least one image.")
    _check_times({SINGLE_FILE: listed})
    return _split(folder, content, listed, SINGLE_FILE, config, notes)


def _split(
    folder: CaptureFolder,
    content: Transforms,
    listed: tuple[RawFrame, ...],
    file: str,
    config: CaptureConfig,
    notes: list[str],
) -> RawCapture:
    """The capture of the frames of one `file`, in splits as it lists them or as images are held out."""
    notes += undistortion_notes(frame.lens for frame in listed)
    frames = with_rig(folder, _by_name(listed), config, notes)
    splits = _listed_splits(folder, content, frames, file, notes)
    if splits is None:
        splits = split_held_out(frames.frames, config.test_every, notes, source=file)
    return _with_points(folder, content, splits, file, notes)


def _by_name(frames: tuple[RawFrame, ...]) -> dict[str, RawFrame]:
    return {frame.image.name: frame for frame in sorted(frames, key=lambda frame: frame.image.name)}


def _with_points(
    folder: CaptureFolder, content: Transforms, splits: dict[Split, tuple[RawFrame, ...]], file: str, notes: list[str]
) -> RawCapture:
    """The capture with the points of `ply_file_path`, which have the axes and the unit of the poses."""
    if not content.ply_file_path:
        return RawCapture("transforms", splits, tuple(notes))
    name = folder.find(content.ply_file_path, source=file, field="ply_file_path") or content.ply_file_path
    return RawCapture.with_points("transforms", splits, notes, *read_ply(name, folder.read(name)))


def _frames(
    folder: CaptureFolder,
    content: Transforms,
    file: str,
    config: CaptureConfig,
    notes: list[str],
    *,
    optional: bool = False,
) -> tuple[RawFrame, ...]:
    """The frames in the order of the file; with `times_from_names` and no times, times are those of the names."""
    frames: list[RawFrame] = []
    indices: dict[str, int] = {}
    scales: list[float] = []
    images = ListedImages(folder, file)
    cameras = TransformsCamera(content, file, config.orientation)
    untimed = all(entry.time is None for entry in content.frames)
    times_from_names = config.times_from_names and untimed and not config.rig
    for index, entry in enumerate(content.frames):
        field = f"frames[{index}]"
        image = images.find(entry.file_path, f"{field}.file_path")
        if image is None:
            continue
        if image.name in indices:
            raise CaptureError(
                f"the image {image.name} is listed twice, first in frames[{indices[image.name]}]",
                file=file,
                field=f"{field}.file_path",
                remedy="Remove one of the entries.",
            )
        indices[image.name] = index
        pose, scale = world_to_camera(entry.transform_matrix, file, f"{field}.transform_matrix")
        scales.append(scale)
        image, camera, lens = cameras.of(entry, pose, image, field)
        mask = None if not entry.mask_path else images.mask(entry.mask_path, image, f"{field}.mask_path")
        time = time_from_name(image.name) if times_from_names else entry.time
        frames.append(RawFrame(image, camera, time, lens, mask))
    notes += images.notes(optional=optional)
    if times_from_names:
        notes += notes_on_points([frame.image.name for frame in frames])
    notes += scale_notes(scales, file)
    return tuple(frames)


def _listed_splits(
    folder: CaptureFolder, content: Transforms, rig: RigFrames, file: str, notes: list[str]
) -> dict[Split, tuple[RawFrame, ...]] | None:
    """The splits that the file lists, or None. Without `train_filenames` all frames that are not held out are train."""
    if all(content.listed(split) is None for split in SPLITS):
        return None
    names: dict[Split, set[str]] = {}
    for split in SPLITS:
        names[split] = set()
        for index, listed in enumerate(content.listed(split) or []):
            field = f"{split}_filenames[{index}]"
            name = folder.find(listed, source=file, field=field)
            if name is None and any(listed == entry.file_path for entry in content.frames):
                continue  # one of the missing images, which have been counted
            meant = rig.named(name or listed)
            if not meant:
                raise CaptureError(
                    f"{listed!r} is no image of frames", file=file, field=field, remedy="Correct or remove the name."
                )
            names[split].update(meant)
    frames = rig.frames
    held_out = names["val"] | names["test"]
    if content.train_filenames is None:
        names["train"] = set(frames) - held_out
    if not names["train"]:
        raise CaptureError(
            "leaves no training image", file=file, field="train_filenames", remedy="Hold fewer images out."
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


def _check_times(files: dict[str, tuple[RawFrame, ...]]) -> None:
    timed = any(frame.time is not None for frames in files.values() for frame in frames)
    for file, frames in files.items():
        for frame in frames:
            if timed and frame.time is None:
                raise CaptureError(
                    "the time is missing here but given for other frames",
                    file=file,
                    field=f"time of {frame.image.name}",
                    remedy="Give every frame a time, or none of them (static scene).",
                )
