"""Rows of the crash matrix: one fault on one backend, what is left of the jobs, and the table."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

from crash.stage import Stage
from pydantic import Field

from graings.document import Document
from graings.storage.run_folder import newest_checkpoint
from jobs.progress import read_progress


class Row(Document):
    """One fault on one backend."""

    fault: str = Field(description="Name of the fault.")
    what: str = Field(description="What happens.")
    backend: str = Field(description="Database of the queue: sqlite or postgresql.")
    skipped: str | None = Field(None, description="Why the fault could not be tried here.")
    stuck: str | None = Field(None, description="What did not happen in time.")
    lost: int | None = Field(None, ge=0, description="Jobs, of two, that did not succeed or are not known any more.")
    twice: bool | None = Field(None, description="Whether two trainers trained the job at the same time.")
    equal: bool | None = Field(None, description="Whether the model has the bits of the undisturbed training.")
    attempts: int | None = Field(None, ge=0, description="Starts of the trainer of the first job.")
    recovery_s: float | None = Field(
        None, ge=0, description="Seconds from the fault, or from its end where it lasts, until training went on."
    )
    total_s: float | None = Field(None, ge=0, description="Seconds of the whole row.")
    notes: tuple[str, ...] = Field((), description="What else happened.")

    @property
    def passed(self) -> bool:
        """Whether nothing was lost."""
        return self.stuck is None and self.lost == 0 and self.twice is False and self.equal is True


class Matrix(Document):
    """All rows, and where they were measured."""

    command: str
    commit: str | None
    machine: str
    rows: tuple[Row, ...]


def digest(stage: Stage) -> str:
    """Of the compact model and of the last checkpoint's scene."""
    newest = newest_checkpoint(stage.folder.run)
    if newest is None or not stage.folder.model.is_file():
        return "no model"
    content = stage.folder.model.read_bytes() + (newest / "scene.safetensors").read_bytes()
    return f"{newest.name} {hashlib.sha256(content).hexdigest()}"


def trained_twice(stage: Stage) -> bool:
    """Whether reports of an earlier attempt follow those of a later one, or an attempt goes back.

    A trainer reports every second, so that two which train together for longer are noticed.
    """
    reports = [report for _, report in read_progress(stage.folder.progress, 0)[0] if report.phase != "loading"]
    order = [(report.attempt, report.iteration) for report in reports]
    return order != sorted(order)


def table(rows: Iterable[Row]) -> str:
    """The rows as Markdown."""
    lines = [
        "| fault | backend | outcome | lost | twice | model | attempts | recovery | notes |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        outcome = "not tried" if row.skipped else "ok" if row.passed else "**defect**"
        seconds = "" if row.recovery_s is None else f"{row.recovery_s:.1f} s"
        equal = {True: "equal", False: "**differs**", None: ""}[row.equal]
        twice = {True: "**yes**", False: "no", None: ""}[row.twice]
        lost, attempts = ("" if value is None else str(value) for value in (row.lost, row.attempts))
        notes = "; ".join(note for note in (row.skipped, row.stuck, *row.notes) if note).replace("|", "/")
        cells = (f"{row.fault}: {row.what}", row.backend, outcome, lost, twice, equal, attempts, seconds, notes)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
