"""The first phase of a job on a video, photographs or a synthetic scene: its capture, in the job's folder."""

from __future__ import annotations

import shutil
import threading
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
    upload: Path, folder: JobFolder, threads: int, iterations: int, progress: ProgressWriter, stop: threading.Event
) -> tuple[Path, list[str]]:
    """The capture to train on: `upload` itself, or what is made of its footage or recipe; and lines for the log.

    An interrupted call continues where it was; a synthetic scene, which takes seconds, begins again. Raises `Stopped`
    when `stop` is set, and `CaptureError` where the footage does not hold together.
    """
    recipe = find_recipe(upload)
    footage = None if recipe else find_footage(upload)
    if recipe is None and footage is None:
        return upload, []
    if (folder.capture / TRANSFORMS).exists():
        return folder.capture, []
    attempts = folder.attempts()

    def observe(step: str, done: int, total: int) -> None:
        progress.write(
            ProgressReport(
                phase="capture",
                step=step,
                step_done=done,
                step_total=total,
                iteration=0,
                iterations=iterations,
                attempt=attempts[-1].number if attempts else 1,
            )
        )
        if stop.is_set():
            raise Stopped

    if recipe is not None:
        shutil.rmtree(folder.capture, ignore_errors=True)  # of a trainer that was killed
        # In this process: those of a pool would outlive a trainer that is killed.
        synthesize(
            recipe.scene,
            folder.capture,
            **recipe.model_dump(exclude={"scene"}),
            observe=lambda done, total: observe("drawing", done, total),
        )
        return folder.capture, [f"drew the synthetic scene {recipe.scene}"]
    assert footage is not None
    try:
        report = make_capture(footage, folder.capture, threads=threads, observe=observe)
    except CaptureError as error:
        # Its client knows the names of the files, and nothing of the folders of this machine.
        raise CaptureError(error.problem, file=Path(error.file).name, field=error.field, remedy=error.remedy) from error
    return folder.capture, lines(report)
