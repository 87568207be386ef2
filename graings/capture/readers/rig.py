"""Rigs: still cameras that were calibrated on one instant, with a folder of frames for each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Final

from graings.capture.folder import CaptureFolder
from graings.capture.image_file import SUFFIXES, ImageFile
from graings.capture.raw_capture import RawFrame
from graings.capture.splits import time_from_name
from graings.config import CaptureConfig
from graings.errors import CaptureError

# Clips of cameras whose frames are not extracted yet.
VIDEO_SUFFIXES: Final = (".mp4", ".mov", ".mkv", ".avi", ".webm")


def with_rig(
    folder: CaptureFolder, frames: Mapping[str, RawFrame], config: CaptureConfig, notes: list[str]
) -> dict[str, RawFrame]:
    """With `config.rig` every frame of the folder of each calibrated image, else `frames` and how to get them.

    The number in a frame's name is its time. Raises `CaptureError` where a camera has no folder.
    """
    folders = {name: frame_folder(folder, name) for name in frames}
    found = {name: place for name, place in folders.items() if place is not None}
    if not config.rig:
        if len(found) > 1 and len(set(found.values())) == len(found):
            count = sum(len(pictures(folder, place)) for place in found.values())
            notes.append(
                f"the images are of one instant: {count} frames of {len(found)} cameras lie in folders of their names "
                f"({next(iter(found.values()))}, …) and are not used; set capture.rig=true to read them"
            )
        return dict(frames)
    timed: dict[str, RawFrame] = {}
    for name, frame in frames.items():
        if name not in found:
            stem = PurePosixPath(name).with_suffix("")
            raise CaptureError(
                f"the camera {name} has no folder of frames (looked for {stem} and {stem.name})",
                file=name,
                field="capture.rig",
                remedy="Put the frames of each camera into a folder of its name.",
            )
        for picture in pictures(folder, found[name]):
            image = _like(folder.image(picture, source=found[name]), frame)
            timed[image.name] = RawFrame(image, frame.camera, time_from_name(image.name), frame.lens)
    notes.append(f"a rig: {len(timed)} frames of {len(frames)} cameras, with the numbers in their names as times")
    return timed


def frame_folder(folder: CaptureFolder, name: str) -> str | None:
    """The folder with the frames of the camera that image `name` calibrates, relative to the capture; None without."""
    stem = PurePosixPath(name).with_suffix("")
    own = [stem, PurePosixPath(stem.name), PurePosixPath("images", stem.name)]
    inside = [stem.parent] if len(stem.parts) > 2 else []  # images/cam00/00000.png lies among the frames themselves
    for place in (*own, *inside):
        if len(pictures(folder, str(place))) > 1:
            return str(place)
    return None


def pictures(folder: CaptureFolder, place: str) -> list[str]:
    """Names of the pictures in a folder of the capture, relative to it, sorted."""
    path = folder.root / place
    if not path.is_dir():
        return []
    return sorted(f"{place}/{file.name}" for file in path.iterdir() if _is_picture(file))


def _is_picture(file: Path) -> bool:
    return file.suffix.lower() in SUFFIXES and not file.name.startswith(".")


def _like(image: ImageFile, frame: RawFrame) -> ImageFile:
    """`image` as the calibrated one is used. Raises `CaptureError` where it has another size."""
    if frame.image.upright:
        image = image.turned()
    if (image.width, image.height) != (frame.image.width, frame.image.height):
        raise CaptureError(
            f"has {image.width}x{image.height} px, the calibrated image {frame.image.name} "
            f"{frame.image.width}x{frame.image.height}",
            file=image.name,
            field="size",
            remedy="Extract the frames at the size of the calibrated images.",
        )
    return image
