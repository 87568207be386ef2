"""Tables: the numbers of a work-precision report as CSV, one row per point; empty where the document has null."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from graings.report.metrics_document import EvaluationPoint
from graings.report.work_precision_document import RenderPart, TimeToPsnr, TrainingPart, WorkPrecision

RENDER_COLUMNS = (
    *("run", "sweep", "scale", "alpha_min", "transmittance_min", "ms_median", "ms_min", "ms_iqr", "ms_networks"),
    *("rmse", "max", "psnr_vs_reference", "lsb8_changed", "on_front"),
)


def tables(report: WorkPrecision) -> dict[str, str]:
    """CSV texts of a report by file name; `render.csv` only where something was rendered."""
    texts = {
        "points.csv": _csv(("run", *EvaluationPoint.model_fields), _points(report.training)),
        "time_to_psnr.csv": _csv(("run", *TimeToPsnr.model_fields), _times(report.training)),
        "phases.csv": _csv(("run", "phase", "seconds", "is_training"), _phases(report.training)),
    }
    if report.render:
        texts["render.csv"] = _csv(RENDER_COLUMNS, _render(report.render))
    return texts


def _points(parts: Sequence[TrainingPart]) -> Iterator[list[Any]]:
    for part in parts:
        yield from ([part.run.name, *point.to_json().values()] for point in part.points)


def _times(parts: Sequence[TrainingPart]) -> Iterator[list[Any]]:
    for part in parts:
        yield from ([part.run.name, *entry.to_json().values()] for entry in part.time_to_psnr)


def _phases(parts: Sequence[TrainingPart]) -> Iterator[list[Any]]:
    for part in parts:
        times = part.phases
        for phase, seconds in times.seconds.items():
            yield [part.run.name, phase, seconds, phase in times.training]
        yield [part.run.name, "unaccounted", times.unaccounted_s, False]


def _render(parts: Sequence[RenderPart]) -> Iterator[list[Any]]:
    for part in parts:
        for point in part.points:
            setting, ms, err = point.setting, point.ms, point.err
            yield [
                *(part.run.name, setting.sweep, setting.scale, setting.alpha_min, setting.transmittance_min),
                *(ms.median, ms.min, ms.iqr, ms.networks),
                *(err.rmse, err.max, err.psnr_vs_reference, err.lsb8_changed, point.on_front),
            ]


def _csv(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()
