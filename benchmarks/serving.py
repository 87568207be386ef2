"""How long a view of a trained model takes, beside the drawing alone.

    python benchmarks/serving.py RUN... [--json FILE] [--px 400 800] [--threads 1 2] [--rounds 40] [--before]

For each model, image size and number of threads, medians in milliseconds of `render` at a time and from a view not seen
before, of `rasterize` for the Gaussians of that view, of `render` from another view at that time (`orbit_ms`), and of
the PNG encoding that the service uses. They are timed in turn in one process, so their ratios mean something on a busy
machine; `ratio_quiet` is that of the lowest tenths, which other processes disturb least. `before_ms` (--before) is the
path that training uses: `Scene.compose`, then `rasterize`. `first_ms` is the first view after a model was read:
preparation and `render`.

A line a PNG level follows: size and milliseconds of one image.

The models of docs/experiments/serving.md:

    graings train hook -o hook20k --set iterations=500 --set density.max_anchors=2000 --set init.max_points=2000 \\
        --set density.min_observations=10
    graings train hook -o hook50k --set iterations=600 --set density.max_anchors=5400 --set init.max_points=5400 \\
        --set density.min_observations=5 --set density.gradient_threshold=2e-5
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from graings import kernel
from graings.camera.camera import View
from graings.image_encoding import encode_image
from graings.raster.rasterize import rasterize
from graings.raster.result import RasterSettings
from graings.render import low_pass, render, render_composition
from graings.scene.prepared import PreparedScene
from graings.storage.compact import open_model
from graings.storage.model import Model

WARM_UPS = 3


def milliseconds(call: Callable[[], Any], times: list[float] | None = None) -> Any:
    """The result of `call`, whose milliseconds are appended to `times`."""
    started = time.perf_counter()
    result = call()
    if times is not None:
        times.append(1e3 * (time.perf_counter() - started))
    return result


def lowest_tenth(times: list[float]) -> float:
    return sorted(times)[len(times) // 10]


def measured(model: Model, name: str, px: int, threads: int, rounds: int, before: bool) -> dict[str, Any]:
    """One row."""
    first: list[float] = []
    views = [view for split in model.views.values() for view in split]
    background = torch.tensor(model.background)

    def at(index: int) -> View:
        view = views[(7 * index) % len(views)]
        longer = max(view.camera.width, view.camera.height)
        size = [max(1, round(side * px / longer)) for side in (view.camera.width, view.camera.height)]
        return View(view.name, view.camera.resized(*size), 0.0)

    def first_view() -> PreparedScene:
        prepared = PreparedScene(model.scene)
        render(prepared, at(0).camera, 0.123, model.background)
        return prepared

    prepared = milliseconds(first_view, first)
    spent: dict[str, list[float]] = {key: [] for key in ("render", "rasterize", "orbit", "encode", "before")}
    gaussians = 0
    for number in range(-WARM_UPS, rounds):
        index = number + WARM_UPS
        moment = (index * 0.6180339887498949) % 1.0  # spread over the clip, never the same twice
        camera, other = at(index).camera, at(index + 1).camera
        into = {key: times if number >= 0 else None for key, times in spent.items()}
        image = milliseconds(lambda: render(prepared, camera, moment, model.background), into["render"])  # noqa: B023
        with torch.inference_mode():
            composed = prepared.compose(camera.center, moment)
            settings = RasterSettings(blur=low_pass(composed, camera))
            arguments = (composed.gaussians, camera, background)
            milliseconds(lambda: rasterize(*arguments, settings=settings, depth=False), into["rasterize"])  # noqa: B023
        milliseconds(lambda: render(prepared, other, moment, model.background), into["orbit"])  # noqa: B023
        milliseconds(lambda: encode_image(np.asarray(image.color), "png"), into["encode"])  # noqa: B023
        gaussians = max(gaussians, len(composed.gaussians))
        if before:

            def unprepared() -> Any:
                with torch.inference_mode():
                    composition = model.scene.compose(camera.center, moment)  # noqa: B023
                    return render_composition(composition, camera, model.background)  # noqa: B023

            expected = milliseconds(unprepared, into["before"])
            assert torch.equal(expected.color, image.color), "the prepared scene draws another image"
    middle = {key: statistics.median(times) for key, times in spent.items() if times}
    row = {
        "model": name,
        "gaussians": gaussians,
        "px": px,
        "threads": threads,
        "render_ms": middle["render"],
        "rasterize_ms": middle["rasterize"],
        "ratio": middle["render"] / middle["rasterize"],
        "ratio_quiet": lowest_tenth(spent["render"]) / lowest_tenth(spent["rasterize"]),
        "orbit_ms": middle["orbit"],
        "encode_ms": middle["encode"],
        "fps": 1e3 / middle["render"],
        "first_ms": first[0],
    }
    if before:
        row |= {"before_ms": middle["before"], "before_ratio": middle["before"] / middle["rasterize"]}
    return {key: round(value, 3) if isinstance(value, float) else value for key, value in row.items()}


def png_levels(model: Model, name: str, px: int, rounds: int) -> list[dict[str, Any]]:
    """Size and milliseconds of one image: run lengths, which is the default (None), and levels of deflate."""
    view = next(iter(model.views.values()))[0]
    scene = PreparedScene(model.scene)
    color = render(scene, view.camera.resized(px, px), 0.5, model.background).color.numpy()
    rows = []
    for level in (None, 0, 1, 3, 6, 9):
        times: list[float] = []
        for _ in range(rounds):
            data = milliseconds(lambda: encode_image(color, "png", png_level=level), times)  # noqa: B023
        rows.append(
            {"model": name, "px": px, "png_level": level, "bytes": len(data), "ms": round(statistics.median(times), 3)}
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--px", type=int, nargs="+", default=[400, 800])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--before", action="store_true", help="also time the path without preparation")
    options = parser.parse_args()

    rows: list[dict[str, Any]] = []
    for run in options.runs:
        model = open_model(run)
        for threads in options.threads:
            with kernel.computing_threads(threads):
                for px in options.px:
                    rows.append(measured(model, run.name, px, threads, options.rounds, options.before))
                    print(json.dumps(rows[-1]), flush=True)
        for px in options.px:
            levels = png_levels(model, run.name, px, max(5, options.rounds // 4))
            rows += levels
            print(*(json.dumps(row) for row in levels), sep="\n", flush=True)
    if options.json is not None:
        machine = {"isa": kernel.active_isa(), "cores": kernel.usable_cores(), "load_average": os.getloadavg()[0]}
        options.json.write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
