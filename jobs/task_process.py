"""The child process that does one task of a job: `python -m jobs.task_process JOB_FOLDER TASK --threads N`.

It ends with an `ExitCode`; if that is an error, standard output is one JSON object with the message. SIGTERM, SIGINT or
the end of its parent end it at once. When the task is taken again, a video goes on where it was if the model is the
same, and an evaluation begins again.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graings.errors import CheckpointError, GraingsError
from graings.export.camera_path import frames_of
from graings.export.shown import open_shown
from graings.export.video import write_video
from graings.kernel import use_threads
from graings.report.evaluate_run import evaluate_run
from graings.storage.locks import locked
from jobs.child_process import GRACE_S
from jobs.exit_code import ExitCode
from jobs.parent import watch_parent
from jobs.store import JobFolder, Store
from jobs.task import EvaluationSpec, TaskFolder, VideoSpec

REPORT_EVERY_S = 0.5
# For a trainer that was asked to stop; one that trains would block all tasks of the worker for hours.
LOCK_WAIT_S = GRACE_S + 15.0


class Ended(BaseException):
    """A signal asked the process to end."""


def main(argv: Sequence[str] | None = None) -> int:
    """Do the task and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m jobs.task_process", description=__doc__)
    parser.add_argument("folder", type=Path, help="the job's folder in the store")
    parser.add_argument("task", help="the task")
    parser.add_argument("--threads", type=int, required=True, help="greatest number of CPU threads")
    arguments = parser.parse_args(argv)
    folder = JobFolder(arguments.folder.resolve())
    try:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, _stop)
        watch_parent(lambda: os.kill(os.getpid(), signal.SIGTERM))
        use_threads(arguments.threads)
        task = TaskFolder(folder.tasks / arguments.task)
        spec = task.record.spec
        if isinstance(spec, VideoSpec):
            _make_video(folder, task, spec)
        else:
            _evaluate(folder, spec)
    except Ended:
        return ExitCode.STOPPED
    except (GraingsError, ValueError) as error:
        return _end(ExitCode.REFUSED, str(error), folder)
    except Exception as error:
        # The outermost frame of the process: the traceback goes to the log, the message to the client.
        traceback.print_exc()
        return _end(ExitCode.CRASHED, f"{type(error).__name__}: {error}. The log has the traceback.", folder)
    return ExitCode.DONE


def _evaluate(folder: JobFolder, spec: EvaluationSpec) -> None:
    capture = Store(folder.path.parent.parent).trained_on(folder.path.name)
    with locked(folder.path / "evaluation.lock"):  # one evaluation after the other
        deadline = time.monotonic() + LOCK_WAIT_S
        while True:
            with locked(folder.lock, wait=False) as free:  # a trainer writes the same metrics
                if free:
                    evaluate_run(folder.run, spec.split, capture)
                    return
            if time.monotonic() >= deadline:
                raise CheckpointError(f"Job {folder.path.name} is being trained. Evaluate it when it has ended.")
            time.sleep(0.2)


def _make_video(folder: JobFolder, task: TaskFolder, spec: VideoSpec) -> None:
    shown = open_shown(folder.run)
    _, _, background = spec.request.resolve(shown.views, shown.units, shown.background)
    frames = frames_of(shown, spec.request, spec.path, spec.moves, spec.frames)
    reported = 0.0

    def observe(done: int) -> None:
        nonlocal reported
        if done == len(frames) or time.monotonic() - reported >= REPORT_EVERY_S:
            task.write_progress(done, len(frames))
            reported = time.monotonic()

    write_video(task.video(spec), shown, frames, background, fps=spec.fps, observe=observe)


def _stop(*_: Any) -> None:
    raise Ended


def _end(code: ExitCode, message: str, folder: JobFolder) -> int:
    print(message, file=sys.stderr, flush=True)
    message = message.replace(f"{folder.path.parent.parent}/", "")  # clients know nothing of the folders here
    print(json.dumps({"error": message}), flush=True)
    return code


if __name__ == "__main__":
    # Without interpreter shutdown, which would wait for the thread that reads standard input. All files are written.
    status = main()
    sys.stdout.flush()
    os._exit(status)
