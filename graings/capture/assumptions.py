"""What is assumed where a capture is silent: times by the names of images, and which of them are held out.

Knows nothing of formats.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePosixPath

from graings.capture.capture import Split
from graings.capture.recording import Shot
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


def hold_out(
    shots: Mapping[str, Shot], every: int, notes: list[str], *, source: str, test: set[str] | None = None
) -> dict[Split, tuple[Shot, ...]]:
    """`shots`, in their order, in three splits; `notes` gets what was decided.

    For test those named by `test`, else every `every`-th; for val every `every`-th of the rest, half a period later.
    Raises `CaptureError` naming `source` where nothing is left to train on.
    """
    names = list(shots)
    if test is None:
        test = set(names[::every]) if len(names) > 1 else set()
        notes.append(f"no split is given: every {every}th image by name is held out for test ({len(test)})")
    rest = [name for name in names if name not in test]
    val = set(rest[every // 2 :: every])
    notes.append(f"of the other images every {every}th is held out for val ({len(val)})")
    train = [name for name in rest if name not in val]
    if not train:
        raise CaptureError("leaves no training image", file=source, remedy="Hold fewer images out.")
    return {
        "train": tuple(shots[name] for name in train),
        "val": tuple(shots[name] for name in rest if name in val),
        "test": tuple(shots[name] for name in names if name in test),
    }
