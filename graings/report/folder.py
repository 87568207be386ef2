"""Report folder: the files of a work-precision report.

    work_precision.json   the document, schema graings.work_precision/1
    *.csv                 points, time_to_psnr, phases and, where models were rendered, render
    training.svg, .png    held-out error against time, iterations and Gaussians, all runs in one figure
    render.svg, .png      error against milliseconds of a frame, where models were rendered

A report that is written again replaces the one before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from graings.config import TrainConfig
from graings.errors import CheckpointError
from graings.report.metrics_document import Metrics
from graings.report.picture import missing_reason, png
from graings.report.plots import training_svg
from graings.report.render_plot import render_svg
from graings.report.render_precision import BUDGET_S, render_part
from graings.report.run_record import read_record
from graings.report.tables import tables
from graings.report.work_precision import read_run, run_names, training_part
from graings.report.work_precision_document import REPORT_FILE, TrainingPart, WorkPrecision
from graings.storage.compact import open_model
from graings.storage.files import write_bytes, write_document, write_text
from graings.storage.run_folder import RECORD_FILE


@dataclass(frozen=True, slots=True)
class WrittenReport:
    """Names of the files in `folder`, the document, and what had to be left out and why."""

    folder: Path
    files: tuple[str, ...]
    document: WorkPrecision
    notes: tuple[str, ...]


def report_runs(
    runs: Sequence[Path], folder: Path, *, render: bool = True, budget_s: float = BUDGET_S
) -> WrittenReport:
    """Write the report of `runs`, folders of runs or their `metrics.json`, to `folder`, figures as SVG and PNG.

    With `render` the model of every run is rendered and timed for about `budget_s` seconds, with the threads of this
    process. A run without a model, and PNG without matplotlib, are left out with a note. Raises `CheckpointError`
    naming a run whose metrics cannot be read, `ValueError` when one is given twice.
    """
    names = run_names(runs)
    training = [_training(name, path) for name, path in zip(names, runs, strict=True)]
    rendered, omissions = [], []
    for name, path in zip(names, runs, strict=True):
        if not render:
            omissions.append(f"{name}: not rendered, because rendering was switched off")
            continue
        try:
            rendered.append(render_part(name, open_model(_folder(path)), budget_s=budget_s))
        except (CheckpointError, ValueError) as error:
            omissions.append(f"{name}: not rendered ({error})")
    report = WorkPrecision(training=tuple(training), render=tuple(rendered), omissions=tuple(omissions))
    return _write(folder, report, with_png=True)


def report_training(name: str, metrics: Metrics, config: TrainConfig, folder: Path) -> WrittenReport:
    """Write the report of a run that still trains: only what takes milliseconds, so no rendering and no PNG."""
    omission = f"{name}: not rendered while it trains"
    training = training_part(name, metrics, config)
    report = WorkPrecision(training=(training,), render=(), omissions=(omission,))
    return _write(folder, report, with_png=False)


def _training(name: str, path: Path) -> TrainingPart:
    metrics, folder = read_run(path), _folder(path)
    config = read_record(folder).config if (folder / RECORD_FILE).is_file() else None
    return training_part(name, metrics, config)


def _folder(path: Path) -> Path:
    return path.parent if path.is_file() else path


def _write(folder: Path, report: WorkPrecision, *, with_png: bool) -> WrittenReport:
    folder.mkdir(parents=True, exist_ok=True)
    drawings = {"training": training_svg([part.model_dump(mode="json") for part in report.training])}
    if report.render:
        drawings["render"] = render_svg([part.model_dump(mode="json") for part in report.render])
    texts = tables(report) | {f"{name}.svg": drawing for name, drawing in drawings.items()}
    # A file that only an earlier report had would contradict this one.
    for stale in {"render.csv", "render.svg", "render.png", "training.png"} - texts.keys():
        (folder / stale).unlink(missing_ok=True)
    write_document(folder / REPORT_FILE, report)
    for name, text in texts.items():
        write_text(folder / name, text)
    files, notes = [REPORT_FILE, *texts], list(report.omissions)
    reason = missing_reason() if with_png else None
    if reason is not None:
        notes.append(f"PNG left out: {reason}")
    elif with_png:
        for name, drawing in drawings.items():
            write_bytes(folder / f"{name}.png", png(drawing))
            files.append(f"{name}.png")
    return WrittenReport(folder, tuple(files), report, tuple(notes))
