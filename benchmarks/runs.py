"""Runs of the benchmarks that train: what is finished is not repeated, what was interrupted is resumed."""

from __future__ import annotations

from pathlib import Path

from graings.config import TrainConfig
from graings.errors import GraingsError
from graings.report.metrics_document import Metrics, read_metrics
from graings.report.run_record import read_record
from graings.storage.run_folder import METRICS_FILE, RECORD_FILE
from graings.training.run import TrainingRun


def finished(folder: Path) -> Metrics | None:
    """Metrics of the last iteration; None before it. Raises `SystemExit` where the run diverged."""
    if not (folder / METRICS_FILE).exists():
        return None
    metrics = read_metrics(folder / METRICS_FILE)
    if metrics.diverged:
        raise SystemExit(
            f"{folder}: diverged ({metrics.diverged_reason}). Look at it, and delete it to train it again."
        )
    ended = metrics.iterations >= metrics.iterations_planned  # an interrupted run may have been evaluated
    return metrics if ended and "val" in metrics.splits else None


def train(folder: Path, capture: Path, config: TrainConfig) -> None:
    """Train a run to its end, or resume it; nothing where it is finished.

    Raises `SystemExit` with the reason where it cannot be trained, as when the capture is broken, and where the run in
    `folder` is of another capture or has other options: its numbers would be taken for those that were asked for.
    """
    begun = (folder / RECORD_FILE).exists()
    if begun:
        check(folder, capture, config)
    if finished(folder) is not None:
        return
    try:
        run = TrainingRun.resume(folder) if begun else TrainingRun.create(capture, folder, config)
        for report in run:
            if report.evaluation is not None:
                print(f"{folder.name}  {report.iteration:,}  {report.evaluation.psnr:.2f} dB", flush=True)
    except GraingsError as error:
        raise SystemExit(f"{folder}: {error}") from error


def check(folder: Path, capture: Path, config: TrainConfig) -> None:
    record = read_record(folder)
    old, new = record.config.model_dump(), config.model_dump()
    different = [name for name in new if old[name] != new[name] and name != "threads"]
    if Path(record.capture.path).resolve() != capture.resolve():
        different.append("capture")
    if different:
        raise SystemExit(f"{folder}: a run with other {', '.join(different)}. Give another folder.")
