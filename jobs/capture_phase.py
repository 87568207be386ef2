"""The first phase of a job on a video, photographs or a synthetic scene: its capture, in the job's folder."""

from __future__ import annotations

import shutil
import threading
import time
from pathlib import Path

from graings.capture.synthetic import find_recipe, synthesize
from graings.errors import CaptureError
from graings.footage.make_capture import TRANSFORMS, make_capture
from graings.footage.report import lines
from graings.footage.source import find_footage
from jobs.progress import ProgressReport, ProgressWriter
from jobs.store import JobFolder


class Stopped(Exception):
    """The job was asked to stop; what is done so far is kept."""


def capture_of(
    upload: Path,
    folder: JobFolder,
    threads: int,
    iterations: int,
    phase_s: dict[str, float],
    progress: ProgressWriter,
    stop: threading.Event,
) -> tuple[Path, list[str]]:
    """The capture to train on: `upload` itself, or what is made of its footage or recipe; and lines for the log.

    What is made is kept. An interrupted call continues where it was; a synthetic scene begins again. `phase_s` are the
    seconds of the job in each phase, to which those of this one are added. Raises `Stopped` when `stop` is set, and
    `CaptureError` where the footage does not hold together.
    """
    recipe = find_recipe(upload)
    footage = None if recipe else find_footage(upload)
    if recipe is None and footage is None:
        return upload, []
    if (folder.capture if recipe else folder.capture / TRANSFORMS).exists():
        return folder.capture, []
    attempts = folder.attempts()
    changed = time.monotonic()

    def book() -> None:
        nonlocal changed
        now = time.monotonic()
        phase_s["capture"] = phase_s.get("capture", 0.0) + now - changed
        changed = now

    def observe(step: str, done: int, total: int) -> None:
        book()
        progress.write(
            ProgressReport(
                phase="capture",
                step=step,
                step_done=done,
                step_total=total,
                iteration=0,
                iterations=iterations,
                attempt=attempts[-1].number if attempts else 1,
                phase_s=phase_s,
            )
        )
        if stop.is_set():
            raise Stopped

    if recipe is not None:
        part = folder.path / "capture.part"  # renamed when it is complete: a job may be extended after it has ended
        shutil.rmtree(part, ignore_errors=True)  # of a trainer that was killed
        # In this process: those of a pool would outlive a trainer that is killed.
        synthesize(
            recipe.scene,
            part,
            **recipe.model_dump(exclude={"scene"}),
            observe=lambda done, total: observe("drawing", done, total),
        )
        part.rename(folder.capture)
        book()
        return folder.capture, [f"drew the synthetic scene {recipe.scene}"]
    assert footage is not None
    try:
        report = make_capture(footage, folder.capture, threads=threads, observe=observe)
    except CaptureError as error:
        # Its client knows the names of the files, and nothing of the folders of this machine.
        raise CaptureError(error.problem, file=Path(error.file).name, field=error.field, remedy=error.remedy) from error
    book()
    return folder.capture, lines(report)
