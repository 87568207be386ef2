"""ReportFolder: the files of a work-precision report.

    work_precision.json   the document, schema graings.work_precision/1
    *.csv                 points, time_to_psnr, phases and, where models were drawn, render
    training.svg, .png    held-out error against time, iterations and Gaussians, all runs in one picture
    render.svg, .png      error against milliseconds of a frame, where models were drawn

A report that is written again replaces the one before. Knows nothing of terminals, jobs or how runs are trained.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from graings.errors import CheckpointError
from graings.report.figure_files import png, svg
from graings.report.render_plot import render_figure
from graings.report.render_precision import BUDGET_S, render_part
from graings.report.report import read_metrics, write_bytes, write_metrics, write_text
from graings.report.tables import tables
from graings.report.training_plot import training_figure
from graings.report.work_precision import document, read_run, run_names, training_part
from graings.storage.compact import open_model

DOCUMENT: Final = "work_precision.json"


@dataclass(frozen=True, slots=True)
class Written:
    """What was written where, the document itself, and what had to be left out and why."""

    folder: Path
    files: tuple[str, ...]
    document: Mapping[str, Any]
    notes: tuple[str, ...]


def report_runs(runs: Sequence[Path], folder: Path, *, render: bool = True, budget_s: float = BUDGET_S) -> Written:
    """Write the report of `runs`, folders of runs or their `metrics.json`, to `folder`, pictures as SVG and PNG.

    With `render` the model of every run is drawn and timed for about `budget_s` seconds, with the threads of this
    process. A run without a model is left out with a note. Raises `CheckpointError` naming a run whose metrics cannot
    be read, `ValueError` when one is given twice.
    """
    names = run_names(runs)
    training = [_training(name, path) for name, path in zip(names, runs, strict=True)]
    rendered, omissions = [], []
    for name, path in zip(names, runs, strict=True):
        if not render:
            omissions.append(f"{name}: not drawn, as asked")
            continue
        try:
            rendered.append(render_part(name, open_model(_folder(path)), budget_s=budget_s))
        except (CheckpointError, ValueError) as error:
            omissions.append(f"{name}: not drawn ({error})")
    return _write(folder, document(training, rendered, omissions), pictures=True)


def report_training(name: str, metrics: Mapping[str, Any], run: Mapping[str, Any], folder: Path) -> Written:
    """Write the report of a run in the middle of it: what costs milliseconds, so no model is drawn and no PNG made."""
    omissions = [f"{name}: not drawn while it trains"]
    return _write(folder, document([training_part(name, metrics, run)], [], omissions), pictures=False)


def _training(name: str, path: Path) -> dict[str, Any]:
    facts = _folder(path) / "run.json"
    return training_part(name, read_run(path), read_metrics(facts) if facts.is_file() else None)


def _folder(path: Path) -> Path:
    return path.parent if path.is_file() else path


def _write(folder: Path, report: Mapping[str, Any], *, pictures: bool) -> Written:
    folder.mkdir(parents=True, exist_ok=True)
    figures = {"training": training_figure(report["training"])}
    if report["render"]:
        figures["render"] = render_figure(report["render"])
    texts = tables(report) | {f"{name}.svg": svg(figure) for name, figure in figures.items()}
    # What only an earlier report had would contradict this one.
    for stale in {"render.csv", "render.svg", "render.png", "training.png"} - texts.keys():
        (folder / stale).unlink(missing_ok=True)
    write_metrics(folder / DOCUMENT, report)
    for name, text in texts.items():
        write_text(folder / name, text)
    files = [DOCUMENT, *texts]
    if pictures:
        for name, figure in figures.items():
            write_bytes(folder / f"{name}.png", png(figure))
            files.append(f"{name}.png")
    return Written(folder, tuple(files), report, tuple(report["omissions"]))
