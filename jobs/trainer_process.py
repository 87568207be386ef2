"""The child process that trains one job: `python -m jobs.trainer_process JOB_FOLDER --threads N`.

A separate process has its own number of threads, returns all its memory, and can crash or be killed without ending
its worker. It continues from the newest checkpoint if there is one, appends its progress to the job's folder, and ends
with an `ExitCode`; if that is an error, standard output is one JSON object with the message. SIGTERM, SIGINT or the end
of its parent make it write a checkpoint and stop. This is the only module of `jobs` that imports training.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graings.config import TrainConfig, restored
from graings.errors import DivergedError, GraingsError
from graings.report.events import Diverged
from graings.report.folder import report_runs
from graings.report.run_record import read_record
from graings.storage.files import write_document
from graings.storage.locks import locked
from graings.storage.run_folder import RECORD_FILE
from graings.training.calibration import calibration
from graings.training.run import TrainingRun
from graings.training.run_output import RunReport
from jobs.capture_phase import Stopped, capture_of
from jobs.exit_code import ExitCode
from jobs.parent import watch_parent
from jobs.progress import ProgressReport, ProgressWriter, last_progress
from jobs.store import JobFolder, Store

REPORT_EVERY_S = 1.0
LOG_EVERY_S = 15.0
REPORT_BUDGET_S = 10.0  # for rendering the finished model for its report


def main(argv: Sequence[str] | None = None) -> int:
    """Train and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m jobs.trainer_process", description=__doc__)
    parser.add_argument("folder", type=Path, help="the job's folder in the store")
    parser.add_argument("--threads", type=int, required=True, help="greatest number of CPU threads")
    arguments = parser.parse_args(argv)

    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    watch_parent(stop.set)
    folder = JobFolder(arguments.folder.resolve())
    while not stop.is_set():
        # The trainer of a worker that was killed may still be writing its last checkpoint, and that of one that is cut
        # off from the database may train on: wait for it, however long.
        with locked(folder.lock, wait=False) as acquired:
            if acquired:
                return _train_or_report(folder, arguments.threads, stop)
        stop.wait(0.2)
    return ExitCode.STOPPED


def _train_or_report(folder: JobFolder, threads: int, stop: threading.Event) -> int:
    """Train, and turn any error into an exit code and a message."""
    try:
        return _train(folder, threads, stop)
    except Stopped:
        _log("stopped while the capture was made; it continues there")
        return ExitCode.STOPPED
    except DivergedError as error:
        return _end(ExitCode.DIVERGED, str(error))
    except GraingsError as error:
        return _end(ExitCode.REFUSED, str(error))
    except Exception as error:
        # The outermost frame of the process: the traceback goes to the log, the message to the client.
        traceback.print_exc()
        return _end(ExitCode.CRASHED, f"{type(error).__name__}: {error}. The log has the traceback.")


def _train(folder: JobFolder, threads: int, stop: threading.Event) -> int:
    spec = folder.spec()
    config = restored(TrainConfig, spec.config, folder.path)
    threads = min(config.threads or threads, threads)
    upload = Store(folder.path.parent.parent).capture(spec.capture)
    checkpoint = folder.checkpoint()
    attempts = folder.attempts()
    attempt = attempts[-1].number if attempts else 1
    earlier = last_progress(folder.progress)
    phase_s = dict(earlier.phase_s) if earlier else {}
    progress = ProgressWriter(folder.progress)
    capture, found = capture_of(upload, folder, threads, config.iterations, phase_s, progress, stop)
    began = time.monotonic()
    for line in found:
        _log(line)
    progress.write(
        ProgressReport(
            phase="loading", iteration=checkpoint or 0, iterations=config.iterations, attempt=attempt, phase_s=phase_s
        )
    )
    calibration(threads)  # the first job on a machine measures it; plans predict with it from then on
    if checkpoint is None:
        shutil.rmtree(folder.run, ignore_errors=True)  # the incomplete run of an attempt without a checkpoint
        run = TrainingRun.create(capture, folder.run, config.model_copy(update={"threads": threads}))
    else:
        _extend(folder.run, config.iterations)
        run = TrainingRun.resume(folder.run, capture=capture, threads=threads)
    _log(f"attempt {attempt}: {threads} threads, from iteration {checkpoint or 0} of {config.iterations}")

    reported = logged = -LOG_EVERY_S
    changed = time.monotonic()
    phase_s["loading"] = phase_s.get("loading", 0.0) + changed - began
    held_out: dict[str, Any] = {}
    try:
        for report in run:
            now = time.monotonic()
            phase_s[report.phase] = phase_s.get(report.phase, 0.0) + now - changed
            changed = now
            if report.evaluation:
                held_out = {"held_out_psnr": report.evaluation.psnr, "held_out_ssim_3dgs": report.evaluation.ssim_3dgs}
            # Events are reported at once, so that clients see a rollback without delay.
            last = report.iteration == report.iterations
            if report.events or report.evaluation or last or now - reported >= REPORT_EVERY_S:
                progress.write(ProgressReport(**_values(report), **held_out, attempt=attempt, phase_s=phase_s))
                reported = now
            if now - logged >= LOG_EVERY_S or report.evaluation or report.events:
                _log(_line(report))
                logged = now
            if stop.is_set() and report.iteration < report.iterations:
                path = run.save()
                _log(f"stopped at iteration {report.iteration}, checkpoint {path.name}")
                return ExitCode.STOPPED
    except DivergedError as error:
        progress.write(
            ProgressReport(
                phase="diverged",
                iteration=run.iteration,
                iterations=run.iterations,
                attempt=attempt,
                phase_s=phase_s,
                events=(Diverged(iteration=run.iteration, reason=str(error)),),
                **held_out,
            )
        )
        raise
    _report(folder)
    _log("finished")
    return ExitCode.DONE


def _extend(run: Path, iterations: int) -> None:
    """Let a run that was extended go on; its rates decay as those of a run of the new length.

    What only the beginning of a training has does not come again: reduced images, a part of the clip, and the look for
    missing objects, after which training might start anew.
    """
    record = read_record(run)
    if record.config.iterations < iterations:
        done = {"low_resolution_until": 0, "time_window": 1.0, "time_window_until": 0}
        longer = record.config.model_copy(update={"iterations": iterations, **done})
        write_document(run / RECORD_FILE, record.model_copy(update={"config": longer}))


def _report(folder: JobFolder) -> None:
    """Write the work-precision report beside the model."""
    try:
        written = report_runs([folder.run], folder.report, budget_s=REPORT_BUDGET_S)
        _log("; ".join([f"report: {', '.join(written.files)}", *written.notes]))
    except Exception as error:
        # The model is trained and saved: an error in its report does not make the job fail.
        traceback.print_exc()
        _log(f"no report: {type(error).__name__}: {error}. Make it with: graings report {folder.run} -o DIR")


def _values(report: RunReport) -> dict[str, Any]:
    speed = report.iterations_per_s
    return {
        "phase": report.phase,
        "iteration": report.iteration,
        "iterations": report.iterations,
        "loss": report.loss,
        "psnr": report.psnr,
        "gaussians": report.gaussians,
        "anchors": report.anchors,
        "iterations_per_s": speed,
        "eta_s": (report.iterations - report.iteration) / speed if speed > 0 else None,
        "train_s": report.train_s,
        "events": report.events,
    }


def _line(report: RunReport) -> str:
    line = (
        f"{report.iteration}/{report.iterations} {report.phase}: loss {report.loss:.5f}, PSNR {report.psnr:.2f} dB, "
        f"{report.gaussians} Gaussians, {report.anchors} anchors, {report.iterations_per_s:.1f} it/s"
    )
    if report.evaluation:
        line += f"; held-out PSNR {report.evaluation.psnr:.2f} dB"
    return "; ".join([line, *(event.message for event in report.events)])


def _log(text: str) -> None:
    """Write one dated line to the job's log, which is standard error."""
    print(time.strftime("%Y-%m-%dT%H:%M:%S%z"), text, file=sys.stderr, flush=True)


def _end(code: ExitCode, message: str) -> int:
    _log(message)
    print(json.dumps({"error": message}), flush=True)
    return code


if __name__ == "__main__":
    # Without interpreter shutdown, which would wait for the thread that reads standard input. All files are written.
    status = main()
    sys.stdout.flush()
    os._exit(status)
