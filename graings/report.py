"""Report: a run's numbers as strict JSON, and held-out error against run time as a drawing.

One line of the drawing serves two axes: on the left the error, on the right the same number in decibels
(PSNR = -20 log10 RMSE). Knows nothing of how numbers are made.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from graings.drawing import page, rule, text
from graings.errors import CheckpointError

WIDTH: Final = 960
HEIGHT: Final = 400
LEFT, RIGHT, TOP, BOTTOM = 66.0, 902.0, 96.0, 336.0
GUTTER: Final = 40.0  # between the two panels
PANEL: Final = (RIGHT - LEFT - GUTTER) / 2
LABEL_ROOM: Final = 44.0  # least distance of two labels on a horizontal axis

# Round numbers for the axes, the most welcome first.
COUNTS: Final = (
    *(10.0**k for k in range(8)),
    *(5 * 10.0**k for k in range(8)),
    *(2 * 10.0**k for k in range(8)),
)
SECONDS: Final = (
    *(1, 10, 60, 600, 3600, 36_000, 360_000, 0.1, 0.01, 0.001),
    *(30, 1800, 18_000, 5, 300, 180_000, 0.5, 0.05),
    *(2, 20, 120, 1200, 7200, 72_000, 0.2, 0.02),
)
DECIBELS: Final = (1, 2, 5, 10, 20)  # steps between grid lines


def write_metrics(path: Path, document: Mapping[str, Any]) -> None:
    """Write strict JSON: never NaN or infinity (`ValueError` naming the key), never half a file."""
    wrong = next(_not_finite(document, ""), None)
    if wrong is not None:
        raise ValueError(f"{path.name}: {wrong} is not finite; say null and give a reason")
    write_text(path, json.dumps(document, indent=2, allow_nan=False) + "\n")


def read_metrics(path: Path) -> dict[str, Any]:
    """A document written by `write_metrics`. Raises `CheckpointError`."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: not readable ({error}). Finish the training run first.") from error
    if not isinstance(document, dict):
        raise CheckpointError(f"{path}: is not a JSON object. Finish the training run again.")
    return document


def write_text(path: Path, text: str) -> None:
    """Replace a file at once: a reader sees the old text or the new one, also after a power cut."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)  # mkstemp makes files for the owner alone
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise


def config_hash(config: BaseModel) -> str:
    """sha256 over the canonical JSON of a configuration."""
    canonical = json.dumps(config.model_dump(mode="json"), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def _not_finite(value: Any, where: str) -> Iterator[str]:
    """Keys of numbers that strict JSON cannot say."""
    if isinstance(value, float) and not math.isfinite(value):
        yield where
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _not_finite(item, f"{where}.{key}" if where else str(key))
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for index, item in enumerate(value):
            yield from _not_finite(item, f"{where}[{index}]")


def curve_svg(points: Sequence[Mapping[str, Any]]) -> str:
    """Draw `points`: mappings with iteration, train_s, psnr, rmse, ssim_3dgs, gaussians and anchors, in order.

    Any number of points makes a picture, also none; those without a PSNR are left out.
    """
    drawn = [point for point in points if point["psnr"] is not None]
    body = _plot(drawn) if drawn else [text(WIDTH / 2, HEIGHT / 2, "no held-out view was evaluated", anchor="middle")]
    title = "Held-out error against run time"
    return page(title, WIDTH, HEIGHT, [text(LEFT, 36, title, "title"), *body])


@dataclass(frozen=True, slots=True)
class _LogAxis:
    """A logarithmic axis over `PANEL` pixels from `left` on, with a little air at both ends."""

    low: float
    high: float
    left: float
    ends: tuple[float, ...]  # the extreme values themselves

    @staticmethod
    def over(values: Sequence[float], left: float) -> _LogAxis:
        smallest = min((value for value in values if value > 0), default=1.0)
        largest = max(*values, smallest)
        low, high = math.log(smallest), math.log(largest)
        air = 0.04 * (high - low) if high > low else 1.0
        ends = (smallest, largest) if high > low else (smallest,)
        return _LogAxis(low - air, high + air, left, ends)

    def at(self, value: float) -> float:
        """Position in pixels; what lies below the axis (such as 0 seconds) sits at its start."""
        share = (math.log(value) - self.low) / (self.high - self.low) if value > 0 else 0.0
        return self.left + PANEL * max(share, 0.0)

    def ticks(self, welcome: Sequence[float]) -> Sequence[float]:
        """Round numbers on this axis that leave room for their labels."""
        chosen: list[float] = []
        for value in welcome:
            inside = self.low <= math.log(value) <= self.high
            if inside and all(abs(self.at(value) - self.at(other)) >= LABEL_ROOM for other in chosen):
                chosen.append(value)
        if len(chosen) < 2:  # a range so short that it holds no round numbers: name its ends
            return self.ends
        return chosen


def _plot(points: Sequence[Mapping[str, Any]]) -> list[str]:
    decibels = [float(point["psnr"]) for point in points]
    span = max(decibels) - min(decibels)
    step = next((step for step in DECIBELS if span / step <= 6), DECIBELS[-1])
    low = step * math.floor(min(decibels) / step - 0.1)
    high = step * math.ceil(max(decibels) / step + 0.4)
    levels = range(low, high + step, step)

    def height(level: float) -> float:
        return BOTTOM - (level - low) / (high - low) * (BOTTOM - TOP)

    last = points[-1]
    summary = (
        f"{last['psnr']:.2f} dB after {_duration(last['train_s'])} of training · {last['iteration']:,} iterations · "
        f"{last['gaussians']:,} Gaussians from {last['anchors']:,} anchors"
    )
    parts = [
        text(LEFT, 58, summary),
        text(LEFT - 10, TOP - 16, "RMSE", "label", "end"),
        text(RIGHT + 10, TOP - 16, "PSNR", "label"),
    ]
    for level in levels:
        parts.append(text(LEFT - 10, height(level) + 4, _error(10 ** (-level / 20)), anchor="end"))
        parts.append(text(RIGHT + 10, height(level) + 4, f"{level} dB"))
    panels: tuple[tuple[str, str, Sequence[float], Callable[[float], str]], ...] = (
        ("train_s", "training time", SECONDS, _duration),
        ("iteration", "iterations", COUNTS, _count),
    )
    for index, (key, label, welcome, name) in enumerate(panels):
        left = LEFT + index * (PANEL + GUTTER)
        values = [float(point[key]) for point in points]
        axis = _LogAxis.over(values, left)
        parts += [rule(left, height(level), left + PANEL, height(level)) for level in levels]
        for value in axis.ticks(welcome):
            parts.append(rule(axis.at(value), TOP, axis.at(value), BOTTOM))
            parts.append(text(axis.at(value), BOTTOM + 20, name(value), anchor="middle"))
        parts.append(rule(left, BOTTOM, left + PANEL, BOTTOM, "axis"))
        parts.append(text(left + PANEL / 2, BOTTOM + 44, label, "label", "middle"))
        places = [(axis.at(value), height(level)) for value, level in zip(values, decibels, strict=True)]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polyline class="curve" points="{path}"/>')
        parts += [_mark(place, point, last=point is last) for place, point in zip(places, points, strict=True)]
        x, y = places[-1]
        parts.append(text(x + 4, y - 13, f"{last['psnr']:.2f} dB", "value", "end"))
    return parts


def _mark(place: tuple[float, float], point: Mapping[str, Any], *, last: bool) -> str:
    x, y = place
    words = (
        f"{point['psnr']:.2f} dB, RMSE {point['rmse']:.4f}, SSIM {point['ssim_3dgs']:.4f}\n"
        f"{_duration(point['train_s'])}, iteration {point['iteration']:,}\n{point['gaussians']:,} Gaussians"
    )
    kind = "point last" if last else "point"
    return f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="3.2"><title>{escape(words)}</title></circle>'


def _duration(seconds: float) -> str:
    for length, unit in ((3600, "h"), (60, "min")):
        if seconds >= length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.3g} s"


def _error(error: float) -> str:
    return f"{error:.3f}" if error >= 0.01 else f"{error:.2g}"


def _count(number: float) -> str:
    return f"{number:.3g}" if number < 1000 else f"{number / 1000:.3g}k"
