"""Tables: the numbers of a work-precision report as CSV, one row per point.

Empty where the document says null. Knows nothing of files or of how the numbers came about.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from graings.config.schedule import TRAINING_PHASES
from graings.report.work_precision import LATER_POINT_KEYS, POINT_KEYS

_POINT_KEYS = (*POINT_KEYS, *LATER_POINT_KEYS)
TIME_KEYS = ("target_db", "train_s", "iteration", "gaussians", "censored_at_s", "at_most_s", "reason")


def tables(document: Mapping[str, Any]) -> dict[str, str]:
    """CSV texts of a report by file name; `render.csv` only where something was rendered."""
    training, render = document["training"], document["render"]
    made = {
        "points.csv": _csv(("run", *_POINT_KEYS), _rows(training, "points", _POINT_KEYS)),
        "time_to_psnr.csv": _csv(("run", *TIME_KEYS), _rows(training, "time_to_psnr", TIME_KEYS)),
        "phases.csv": _csv(("run", "phase", "seconds", "is_training"), _phases(training)),
    }
    if render:
        made["render.csv"] = _csv(RENDER_COLUMNS, _render(render))
    return made


RENDER_COLUMNS = (
    *("run", "sweep", "scale", "alpha_min", "transmittance_min", "ms_median", "ms_min", "ms_iqr", "ms_networks"),
    *("rmse", "max", "psnr_vs_reference", "lsb8_changed", "on_front"),
)


def _rows(parts: Sequence[Mapping[str, Any]], name: str, keys: Sequence[str]) -> Iterator[list[Any]]:
    for part in parts:
        for row in part[name]:
            yield [part["run"]["name"], *(row.get(key) for key in keys)]


def _phases(parts: Sequence[Mapping[str, Any]]) -> Iterator[list[Any]]:
    for part in parts:
        spent = part["phases"]
        for phase, seconds in spent["seconds"].items():
            yield [part["run"]["name"], phase, seconds, phase in TRAINING_PHASES]
        yield [part["run"]["name"], "unaccounted", spent["unaccounted_s"], False]


def _render(parts: Sequence[Mapping[str, Any]]) -> Iterator[list[Any]]:
    for part in parts:
        for point in part["points"]:
            setting, ms, err = point["setting"], point["ms"], point["err"]
            yield [
                *(part["run"]["name"], setting["sweep"], setting["scale"]),
                *(setting["alpha_min"], setting["transmittance_min"]),
                *(ms["median"], ms["min"], ms["iqr"], ms["networks"]),
                *(err["rmse"], err["max"], err["psnr_vs_reference"], err["lsb8_changed"], point["on_front"]),
            ]


def _csv(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()
