"""What a motion basis costs and how far its images are from the exact ones, by its rank.

    python benchmarks/motion_basis.py RUN... [--pixels 2 1 0.5 0.2 0.1 0.05] [--views 24] [--json FILE]

For each model and bound in px: rank, children with weights, error in px (RMS, 99 %, largest), PSNR of images against
the exact ones (held-out views at times between the training frames, full size, mean square error of all), with the
residual averaged over views (`psnr`) and exact (`psnr_view`); the largest difference of a channel in grey levels; bytes
of weights and functions; CPU milliseconds of the geometry of one time, by the basis and exact, on one thread.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from graings import kernel
from graings.camera.camera import View
from graings.evaluation.metrics import MSE_FLOOR
from graings.render import render
from graings.scene.motion_basis import MotionBasis
from graings.scene.prepared import PreparedScene
from graings.storage.compact import open_model
from graings.storage.model import Model

ROUNDS = 30


def difference(model: Model, one: PreparedScene, other: PreparedScene, views: Sequence[View]) -> tuple[float, float]:
    """PSNR in dB, at most 100, and largest difference in grey levels of two scenes."""
    squares, largest = [], 0.0
    for number, view in enumerate(views):
        moment = (number * 0.6180339887498949) % 1.0
        images = [render(scene, view.camera, moment, model.background).color for scene in (one, other)]
        change = images[0] - images[1]
        squares.append(float(change.square().mean()))
        largest = max(largest, 255 * float(change.abs().max()))
    mean = statistics.mean(squares)
    return -10 * math.log10(max(mean, MSE_FLOOR)), largest


def cpu_ms(call: Callable[[float], Any]) -> float:
    """Median CPU milliseconds of a call at different times."""
    found = []
    for number in range(ROUNDS):
        started = time.process_time()
        call((number * 0.6180339887498949) % 1.0)
        found.append(1e3 * (time.process_time() - started))
    return statistics.median(found)


def measured(model: Model, name: str, exact: PreparedScene, pixels: float, views: Sequence[View]) -> dict[str, Any]:
    """One row."""
    started = time.process_time()
    basis = MotionBasis.of(exact, model.views["train"], pixels=pixels)
    seconds = time.process_time() - started
    report, rows = basis.report, torch.arange(exact.children)
    fast = basis.prepared(exact, view_levels=math.inf)
    psnr, largest = difference(model, exact, fast, views)
    psnr_view, _ = difference(model, exact, basis.prepared(exact, view_levels=0.0), views)
    return {
        "model": name,
        "children": exact.children,
        "bound_px": pixels,
        "rank": basis.geometry.rank,
        "moving": len(basis.geometry.rows),
        "px": report.geometry.error.model_dump(),
        "levels": report.residual.error.model_dump() | {"rank": basis.residual.rank},
        "view_levels": report.residual_of_views.model_dump(),
        "psnr": psnr,
        "psnr_view": psnr_view,
        "largest_levels": largest,
        "bytes": basis.geometry.bytes,
        "residual_bytes": basis.residual.bytes,
        "all_bytes": basis.bytes,
        "geometry_ms": cpu_ms(lambda moment: fast.geometry(moment, rows)),
        "exact_geometry_ms": cpu_ms(lambda moment: exact.geometry(moment, rows)),
        "fit_cpu_s": seconds,
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    lines = [
        "| model | bound px | rank | moving | px RMS | p99 | max | dB | dB, view exact | levels | KB | ms | exact |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        px = [f"{row['px'][name]:.2g}" for name in ("rms", "p99", "max")]
        cells = [row["model"], row["bound_px"], row["rank"], f"{row['moving']} of {row['children']}", *px]
        cells += [f"{row[name]:.1f}" for name in ("psnr", "psnr_view", "largest_levels")]
        cells += [f"{row['bytes'] / 1e3:.0f}", f"{row['geometry_ms']:.2f}", f"{row['exact_geometry_ms']:.2f}"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--pixels", type=float, nargs="+", default=[2.0, 1.0, 0.5, 0.2, 0.1, 0.05])
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    kernel.use_threads(1)
    rows = []
    for run in options.runs:
        model = open_model(run)
        views = (model.views.get("test") or model.views.get("val") or model.views["train"])[: options.views]
        exact = PreparedScene(model.scene)
        for pixels in options.pixels:
            rows.append(measured(model, run.name, exact, pixels, views))
            print(json.dumps(rows[-1]), flush=True)
    print(table(rows))
    if options.json is not None:
        options.json.write_text(json.dumps({"isa": kernel.active_isa(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
