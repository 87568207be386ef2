"""The number in the name of a picture: its time, or its place in a sequence.

The last number counts. Digits with a point between them are a decimal number where they stand alone or behind `t` or
`time`: `1305031102.300000.png`, `t_0.5.png`, `time0.25.png`. Behind another word the first digits belong to the word,
so `shot1.0001.png` is frame 1 of `shot1`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Final

import numpy as np
from numpy.typing import NDArray

_DECIMAL: Final = r"(?:(?<![^\W_])(?<!\.)|(?<![^\W_])(?:time|t))(?P<decimal>\d+\.\d+)(?!\.?\d)"
_NUMBER: Final = re.compile(rf"{_DECIMAL}|(?P<whole>\d+)", re.IGNORECASE)
_LAST_WITH_POINT: Final = re.compile(r"(\d+)\.(\d+)\D*$")


def number_in_name(image: str) -> float | None:
    """The number in the file name of `image`; None where there is none."""
    found = list(_NUMBER.finditer(_stem(image)))
    return float(found[-1]["decimal"] or found[-1]["whole"]) if found else None


def notes_on_points(images: Sequence[str]) -> list[str]:
    """A note for each way in which points in the names of `images` were read, if the other way gives other times."""
    taken = {image: number for image in images if (number := number_in_name(image)) is not None}
    other = {image: _other_reading(image, number) for image, number in taken.items()}
    if _same_times(list(taken.values()), list(other.values())):
        return []
    notes = []
    for decimal in (True, False):
        example = next((i for i in taken if taken[i] != other[i] and _is_decimal(i, taken[i]) == decimal), None)
        if example is None:
            continue
        counting, remedy = (
            ("only the digits behind the point count", "write _ in place of the point")
            if decimal
            else ("the digits before the point count too", "write t in front of them")
        )
        notes.append(
            f"{example} is taken as {taken[example]:.16g}: if {counting} ({other[example]:.16g}), {remedy}, or give "
            "the times in the capture"
        )
    return notes


def _stem(image: str) -> str:
    """The name without its suffix. A suffix of digits, in a name that was listed without one, is part of the number."""
    path = PurePosixPath(image)
    return path.name if path.suffix[1:].isdigit() else path.stem


def _is_decimal(image: str, number: float) -> bool:
    found = _LAST_WITH_POINT.search(_stem(image))
    return found is not None and number == float(f"{found[1]}.{found[2]}")


def _other_reading(image: str, number: float) -> float:
    """The number if the digits before the last point belonged to it and do not, or the other way round."""
    found = _LAST_WITH_POINT.search(_stem(image))
    if found is None:
        return number
    return float(found[2]) if _is_decimal(image, number) else float(f"{found[1]}.{found[2]}")


def _same_times(one: Sequence[float], other: Sequence[float]) -> bool:
    """Whether two readings differ in unit and start at most."""

    def normalized(values: Sequence[float]) -> NDArray[np.float64]:
        times = np.asarray(values, np.float64) - min(values, default=0.0)
        return np.asarray(times / (times.max(initial=0.0) or 1.0))

    with np.errstate(invalid="ignore"):  # hundreds of digits are infinite, and refused later
        return bool(np.allclose(normalized(one), normalized(other), atol=1e-6))
