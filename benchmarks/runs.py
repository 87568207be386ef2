"""Runs of the benchmarks that train: what is finished is not repeated, what was interrupted is resumed."""

from __future__ import annotations

from pathlib import Path

from graings.config import TrainConfig
from graings.report.metrics_document import Metrics, read_metrics
from graings.storage.run_folder import METRICS_FILE, RECORD_FILE
from graings.training.run import TrainingRun


def finished(folder: Path) -> Metrics | None:
    """Metrics of the last iteration; None before it."""
    if not (folder / METRICS_FILE).exists():
        return None
    metrics = read_metrics(folder / METRICS_FILE)
    return metrics if "val" in metrics.splits else None


def train(folder: Path, capture: Path, config: TrainConfig) -> None:
    """Train a run to its end, or resume it; nothing where it is finished."""
    if finished(folder) is not None:
        return
    run = TrainingRun.resume(folder) if (folder / RECORD_FILE).exists() else TrainingRun.create(capture, folder, config)
    for report in run:
        if report.evaluation is not None:
            print(f"{folder.name}  {report.iteration:,}  {report.evaluation.psnr:.2f} dB", flush=True)
