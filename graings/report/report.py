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
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

from graings.errors import CheckpointError
from graings.report.drawing import COUNTS, SECONDS, DecibelAxis, LogAxis, line, mark, panel, svg, text
from graings.report.formatting import count, duration

METRICS_SCHEMA: Final = "graings.metrics/1"

WIDTH: Final = 960
HEIGHT: Final = 400
LEFT, RIGHT, TOP, BOTTOM = 66.0, 902.0, 96.0, 336.0
GUTTER: Final = 40.0  # between the two panels
PANEL: Final = (RIGHT - LEFT - GUTTER) / 2


def write_metrics(path: Path, document: Mapping[str, Any]) -> None:
    """Write strict JSON: never NaN or infinity (`ValueError` naming the key), never half a file."""
    wrong = next(_not_finite(document, ""), None)
    if wrong is not None:
        raise ValueError(f"{path.name}: {wrong} is not finite; say null and give a reason")
    write_text(path, json.dumps(document, indent=2, allow_nan=False) + "\n")


def read_metrics(path: Path) -> dict[str, Any]:
    """A document written by `write_metrics`. Raises `CheckpointError`, also for NaN and infinity."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: not readable ({error}). Finish the training run first.") from error
    if not isinstance(document, dict):
        raise CheckpointError(f"{path}: is not a JSON object. Finish the training run again.")
    return document


def write_text(path: Path, text: str) -> None:
    """Replace a file at once: a reader sees the old text or the new one, also after a power cut."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """As `write_text`, for what is not text."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
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


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not strict JSON")


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
    return svg(WIDTH, HEIGHT, title, [text(LEFT, 36, title, "title"), *body])


def _plot(points: Sequence[Mapping[str, Any]]) -> list[str]:
    decibels = [float(point["psnr"]) for point in points]
    quality = DecibelAxis.over(decibels, TOP, BOTTOM)
    last = points[-1]
    summary = (
        f"{last['psnr']:.2f} dB after {duration(last['train_s'])} of training · {last['iteration']:,} iterations · "
        f"{last['gaussians']:,} Gaussians from {last['anchors']:,} anchors"
    )
    parts = [text(LEFT, 58, summary), *quality.names(LEFT - 10, RIGHT + 10)]
    panels: tuple[tuple[str, str, Sequence[float], Callable[[float], str]], ...] = (
        ("train_s", "training time", SECONDS, duration),
        ("iteration", "iterations", COUNTS, count),
    )
    for index, (key, label, welcome, name) in enumerate(panels):
        left = LEFT + index * (PANEL + GUTTER)
        values = [float(point[key]) for point in points]
        axis = LogAxis.over(values, left, PANEL)
        parts += panel(axis, quality, label, welcome, name)
        places = [(axis.at(value), quality.at(level)) for value, level in zip(values, decibels, strict=True)]
        parts.append(line(places))
        parts += [
            mark(place, point_words(point), "point last" if point is last else "point")
            for place, point in zip(places, points, strict=True)
        ]
        x, y = places[-1]
        parts.append(text(x + 4, y - 13, f"{last['psnr']:.2f} dB", "value", "end"))
    return parts


def point_words(point: Mapping[str, Any]) -> str:
    """What one evaluation says when the pointer rests on it."""
    return (
        f"{point['psnr']:.2f} dB, RMSE {point['rmse']:.4f}, SSIM {point['ssim_3dgs']:.4f}\n"
        f"{duration(point['train_s'])}, iteration {point['iteration']:,}\n{point['gaussians']:,} Gaussians"
    )
