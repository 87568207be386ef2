"""Rigs: still cameras that were calibrated on one instant, with a folder of frames for each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Final

from graings.capture.folder import CaptureFolder
from graings.capture.image_file import ImageFile
from graings.capture.number_in_name import notes_on_points
from graings.capture.raw_capture import RawFrame
from graings.capture.splits import time_from_name
from graings.config import CaptureConfig
from graings.errors import CaptureError

# Clips of cameras whose frames are not extracted yet.
VIDEO_SUFFIXES: Final = (".mp4", ".mov", ".mkv", ".avi", ".webm")


@dataclass(frozen=True, slots=True)
class RigFrames:
    """Frames by name, and the names of those that each listed image stands for: itself, or all of its camera."""

    frames: dict[str, RawFrame]
    of_image: dict[str, tuple[str, ...]]

    def named(self, name: str) -> tuple[str, ...]:
        """The names of the frames that `name` means, which is that of a listed image or of a frame; () for others."""
        return self.of_image.get(name, (name,) if name in self.frames else ())


def with_rig(
    folder: CaptureFolder, frames: Mapping[str, RawFrame], config: CaptureConfig, notes: list[str]
) -> RigFrames:
    """With `config.rig` every frame of the folder of each calibrated image, else `frames` and how to get them.

    The number in a frame's name is its time; the mask of a calibrated image is that of its camera. Raises
    `CaptureError` where a camera has no folder, or two have the same.
    """
    folders = {name: frame_folder(folder, name) for name in frames}
    found = {name: place for name, place in folders.items() if place is not None}
    if not config.rig:
        if len(found) > 1 and len(set(found.values())) == len(found):
            count = sum(len(folder.pictures(place)) for place in found.values())
            notes.append(
                f"the images are of one instant: {count} frames of {len(found)} cameras lie in folders of their names "
                f"({next(iter(found.values()))}, …) and are not used; set capture.rig=true to read them"
            )
        return RigFrames(dict(frames), {name: (name,) for name in frames})
    of_image: dict[str, tuple[str, ...]] = {}
    timed: dict[str, RawFrame] = {}
    cameras: dict[str, str] = {}  # the listed image of each folder
    for name, frame in frames.items():
        if name not in found:
            stem = PurePosixPath(name).with_suffix("")
            raise CaptureError(
                f"the camera {name} has no folder of frames (looked for {stem} and {stem.name})",
                file=name,
                field="capture.rig",
                remedy="Put the frames of each camera into a folder of its name, or set capture.rig=false.",
            )
        place = found[name]
        if place in cameras:
            raise CaptureError(
                f"{cameras[place]} and {name} are listed, whose frames lie in one folder: not a camera each",
                file=name,
                field="capture.rig",
                remedy="Set capture.rig=false.",
            )
        cameras[place] = name
        images = [_like(folder.image(picture, source=place), frame) for picture in folder.pictures(place)]
        timed |= {image.name: replace(frame, image=image, time=time_from_name(image.name)) for image in images}
        of_image[name] = tuple(image.name for image in images)
    if frames:
        notes.append(f"a rig: {len(timed)} frames of {len(frames)} cameras, with the numbers in their names as times")
        notes += notes_on_points(list(timed))
    return RigFrames(timed, of_image)


def refuse_rig(config: CaptureConfig, file: str) -> None:
    """Raise `CaptureError` with `config.rig`, for a format whose `file` lists every frame itself."""
    if config.rig:
        raise CaptureError(
            "lists every frame itself, so that no folders of frames are read beside it",
            file=file,
            field="capture.rig",
            remedy="Set capture.rig=false.",
        )


def frame_folder(folder: CaptureFolder, name: str) -> str | None:
    """The folder with the frames of the camera that image `name` calibrates, relative to the capture; None without."""
    stem = PurePosixPath(name).with_suffix("")
    own = [stem, PurePosixPath(stem.name), PurePosixPath("images", stem.name)]
    inside = [stem.parent] if len(stem.parts) > 2 else []  # images/cam00/00000.png lies among the frames themselves
    for place in (*own, *inside):
        if len(folder.pictures(str(place))) > 1:
            return str(place)
    return None


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
