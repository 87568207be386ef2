"""Progress: what a training job reports, as JSON lines in a file.

The trainer appends; other processes may read at the same time. A position in the file is the id of a report, so that
a reader whose connection broke continues exactly where it was.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationError

from graings.document import Document
from graings.report.events import Event

_TAIL_BYTES = 65_536  # many times the longest line


def _finite(value: Any) -> Any:
    """The value, or None for a number that JSON does not have."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


Number = Annotated[float | None, BeforeValidator(_finite)]


class ProgressReport(Document):
    """One report of the trainer. Numbers are null where there is no step yet or where they are not finite."""

    phase: Literal["capture", "loading", "warmup", "joint", "static", "diverged"] = Field(
        description="What the job does; `capture` makes one of a video or of photographs."
    )
    step: str | None = Field(
        None, description="Part of the phase `capture`: frames, features, matching, mapping, ...; drawing."
    )
    step_done: int | None = Field(None, ge=0, description="How much of this part is done.")
    step_total: int | None = Field(None, ge=0, description="Its whole.")
    iteration: int = Field(ge=0, description="Iterations done.")
    iterations: int = Field(
        ge=0, description="Iterations of the whole run. They grow when training is restarted (event `restart`)."
    )
    attempt: int = Field(ge=0, description="Number of this start of the trainer, from 1.")
    loss: Number = Field(None, description="Loss of the last step.")
    psnr: Number = Field(None, description="Mean PSNR of the training views of the last step, in dB.")
    gaussians: int | None = Field(None, ge=0, description="Gaussians drawn in any view of the last step.")
    anchors: int | None = Field(None, ge=0, description="Anchors of the scene.")
    iterations_per_s: Number = Field(None, description="Iterations per second over the last few seconds.")
    eta_s: Number = Field(None, description="Seconds of training left at this rate.")
    train_s: Number = Field(None, description="Seconds of training so far, evaluations not counted.")
    phase_s: dict[str, float] = Field(
        default_factory=dict, description="Seconds spent in each phase so far, by all attempts, evaluations included."
    )
    held_out_psnr: Number = Field(None, description="PSNR of the last evaluation of this attempt, in dB.")
    held_out_ssim_3dgs: Number = Field(None, description="SSIM of the last evaluation of this attempt.")
    events: tuple[Event, ...] = Field((), description="What happened in the last step, beside an ordinary step.")


class ProgressWriter:
    """Appends reports to a progress file; a line that a crash left incomplete is ended first."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("ab", buffering=0)
        if self._file.tell() > 0:
            with path.open("rb") as old:
                old.seek(-1, os.SEEK_END)
                if old.read(1) != b"\n":
                    self._file.write(b"\n")

    def write(self, report: ProgressReport) -> None:
        """Append one report."""
        # A single write, so that a reader hardly ever sees half a line.
        self._file.write(report.model_dump_json().encode() + b"\n")

    def close(self) -> None:
        self._file.close()


def last_progress(path: Path) -> ProgressReport | None:
    """The newest complete report, or None."""
    reports, _ = read_progress(path, max(0, _size(path) - _TAIL_BYTES))
    return reports[-1][1] if reports else None


def read_progress(path: Path, start: int) -> tuple[list[tuple[int, ProgressReport]], int]:
    """Complete reports from byte `start` on, each with the position after it, and the position to continue from.

    A `start` in the middle of a line skips the rest of that line; one beyond the end counts as the end. A line that is
    no report, such as one that a crash left incomplete, is skipped.
    """
    if not path.exists():
        return [], start
    with path.open("rb") as file:
        start = min(start, file.seek(0, os.SEEK_END))
        if start > 0:
            file.seek(start - 1)
            file.readline()  # only the newline itself where `start` is the beginning of a line
            start = file.tell()
        file.seek(start)
        content = file.read()
    reports: list[tuple[int, ProgressReport]] = []
    position = start
    for line in content.splitlines(keepends=True):
        if not line.endswith(b"\n"):
            break
        position += len(line)
        report = _parse(line)
        if report is not None:
            reports.append((position, report))
    return reports, position


def last_start(path: Path) -> int:
    """Where the newest complete report begins, for readers who want it and what follows."""
    reports, end = read_progress(path, max(0, _size(path) - _TAIL_BYTES))
    return reports[-2][0] if len(reports) > 1 else (0 if end <= _TAIL_BYTES else end)


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _parse(line: bytes) -> ProgressReport | None:
    try:
        return ProgressReport.model_validate_json(line)
    except ValidationError:
        return None
