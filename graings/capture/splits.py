"""Defaults for captures without times or splits: times from file names, and held-out images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from graings.capture.capture import Split
from graings.capture.number_in_name import number_in_name
from graings.capture.raw_capture import RawFrame
from graings.errors import CaptureError


def time_from_name(image: str) -> float:
    """The number in the file name of `image`. Raises `CaptureError` naming the image where there is none."""
    number = number_in_name(image)
    if number is None:
        raise CaptureError(
            "the file name contains no number to take the time from",
            file=image,
            field="name",
            remedy="Rename it, add the times to the capture, or switch capture.times_from_names off.",
        )
    return number


def split_held_out(
    frames: Mapping[str, RawFrame], every: int, notes: list[str], *, source: str, test: set[str] | None = None
) -> dict[Split, tuple[RawFrame, ...]]:
    """`frames`, in their order, in three splits; the choice is appended to `notes`.

    The test split has the images named by `test`, else every `every`-th; the val split every `every`-th of the rest,
    with an offset of half a period. Of a rig of fixed cameras whole cameras are held out, because neighbouring times of
    a training camera would not test new viewpoints. Raises `CaptureError` naming `source` where no training image
    remains.
    """
    names = list(frames)
    unit, groups = _groups(frames, [name for name in names if name not in (test or ())], every)
    if test is None:
        test = {name for group in groups[::every] for name in group} if len(names) > 1 else set()
        notes.append(f"no split is given: every {every}th {unit} by name is held out for test ({len(test)} images)")
    rest = [name for name in names if name not in test]
    rest_groups = [group for group in groups if group[0] not in test]
    val = {name for group in rest_groups[every // 2 :: every] for name in group}
    notes.append(f"every {every}th of the other {unit}s is held out for val ({len(val)} images)")
    train = [name for name in rest if name not in val]
    if not train:
        raise CaptureError("leaves no training image", file=source, remedy="Hold fewer images out.")
    return {
        "train": tuple(frames[name] for name in train),
        "val": tuple(frames[name] for name in rest if name in val),
        "test": tuple(frames[name] for name in names if name in test),
    }


def _groups(frames: Mapping[str, RawFrame], names: Sequence[str], min_cameras: int) -> tuple[str, list[list[str]]]:
    """The unit that is held out as a whole, "camera" or "image", and its groups of names, in the order of `names`.

    Cameras of a rig: at least `min_cameras` fixed cameras with two or more images each, and times. Files repeat the
    pose of a fixed camera with the same digits, so equal poses are the same camera. Else single images.
    """
    cameras: dict[bytes, list[str]] = {}
    for name in names:
        cameras.setdefault(frames[name].camera.world_to_camera.tobytes(), []).append(name)
    timed = all(frames[name].time is not None for name in names)
    if timed and len(cameras) >= min_cameras and min(map(len, cameras.values())) > 1:
        return "camera", list(cameras.values())
    return "image", [[name] for name in names]
