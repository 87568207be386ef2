"""What is assumed where a capture is silent: times by the names of images, and which of them are held out.

Knows nothing of formats.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath

from graings.capture.capture import Split
from graings.capture.raw_capture import RawFrame
from graings.errors import CaptureError


def time_from_name(image: str) -> float:
    """The last number in the name of `image`, which is the file to complain of. Raises `CaptureError` without one."""
    numbers = re.findall(r"\d+", PurePosixPath(image).stem)
    if not numbers:
        raise CaptureError(
            "the file name holds no number to take the time from",
            file=image,
            field="name",
            remedy="Rename it, write the times down, or switch capture.times_from_names off.",
        )
    return float(numbers[-1])


def split_held_out(
    shots: Mapping[str, RawFrame], every: int, notes: list[str], *, source: str, test: set[str] | None = None
) -> dict[Split, tuple[RawFrame, ...]]:
    """`shots`, in their order, in three splits; `notes` gets what was decided.

    For test those named by `test`, else every `every`-th; for val every `every`-th of the rest, half a period later. Of
    a rig those are whole cameras: what a camera sees an instant before and after says nothing of other places.
    Raises `CaptureError` naming `source` where nothing is left to train on.
    """
    names = list(shots)
    what, groups = _groups(shots, [name for name in names if name not in (test or ())], every)
    if test is None:
        test = {name for group in groups[::every] for name in group} if len(names) > 1 else set()
        notes.append(f"no split is given: every {every}th {what} by name is held out for test ({len(test)} images)")
    rest = [name for name in names if name not in test]
    left = [group for group in groups if group[0] not in test]
    val = {name for group in left[every // 2 :: every] for name in group}
    notes.append(f"of the other {what}s every {every}th is held out for val ({len(val)} images)")
    train = [name for name in rest if name not in val]
    if not train:
        raise CaptureError("leaves no training image", file=source, remedy="Hold fewer images out.")
    return {
        "train": tuple(shots[name] for name in train),
        "val": tuple(shots[name] for name in rest if name in val),
        "test": tuple(shots[name] for name in names if name in test),
    }


def _groups(shots: Mapping[str, RawFrame], names: Sequence[str], least: int) -> tuple[str, list[list[str]]]:
    """What is held out together, each in the order of `names`, and what to call one of them.

    The images of a camera that stays in place, where there are times and at least `least` cameras, each with two images
    or more; else each image by itself. Files give such a camera the same numbers every time.
    """
    cameras: dict[bytes, list[str]] = {}
    for name in names:
        cameras.setdefault(shots[name].camera.world_to_camera.tobytes(), []).append(name)
    timed = all(shots[name].time is not None for name in names)
    if timed and len(cameras) >= least and min(map(len, cameras.values())) > 1:
        return "camera", list(cameras.values())
    return "image", [[name] for name in names]
