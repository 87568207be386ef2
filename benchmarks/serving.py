"""How long a view of a trained model takes, beside the drawing alone.

    python benchmarks/serving.py RUN... [--json FILE] [--px 400 800] [--threads 1 2] [--rounds 40] [--before]

For each model, image size and number of threads, medians in milliseconds of `render` at a time and from a view not seen
before, of the same with the motion basis (`fast_ms`), of `rasterize` for the Gaussians of that view, of `render` from
another view at that time (`orbit_ms`), and of the PNG encoding that the service uses. They are timed in turn in one
process, so their ratios mean something on a busy machine. Other processes disturb a longer call more often: `ratio_cpu`
is the ratio of the CPU times, with one thread, which do not count what other processes take. `before_ms` (--before) is
the path that training uses, `Scene.compose` and then `rasterize`; its image must have the same bits. `first_ms` is the
first view after a model was read: preparation and `render`. `fast_first_s` is what the motion basis takes beside,
once for a model.

Lines for the PNG levels follow: size and CPU milliseconds of one image.

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
from graings.camera.camera import Camera
from graings.image_encoding import encode_image
from graings.raster.rasterize import rasterize
from graings.raster.result import RasterSettings
from graings.render import FastScene, low_pass, render, render_composition
from graings.scene.prepared import PreparedScene
from graings.storage.compact import open_model
from graings.storage.model import Model

WARM_UPS = 3


class Times:
    """Milliseconds of calls, by the clock and on the CPU."""

    def __init__(self) -> None:
        self.wall: list[float] = []
        self.cpu: list[float] = []

    def of(self, call: Callable[[], Any], counted: bool = True) -> Any:
        """The result of `call`."""
        started, started_cpu = time.perf_counter(), time.process_time()
        result = call()
        if counted:
            self.wall.append(1e3 * (time.perf_counter() - started))
            self.cpu.append(1e3 * (time.process_time() - started_cpu))
        return result

    @property
    def median(self) -> float:
        return statistics.median(self.wall)


def measured(model: Model, name: str, px: int, threads: int, rounds: int, before: bool) -> dict[str, Any]:
    """One row."""
    views = [view for split in model.views.values() for view in split]
    background = torch.tensor(model.background)
    first, drawn, raster, orbit, encoded, unprepared, approximated = (Times() for _ in range(7))
    gaussians = 0

    def camera_of(index: int) -> Camera:
        camera = views[(7 * index) % len(views)].camera
        longer = max(camera.width, camera.height)
        return camera.resized(*(max(1, round(side * px / longer)) for side in (camera.width, camera.height)))

    def one_round(index: int, counted: bool) -> None:
        nonlocal gaussians
        moment = (index * 0.6180339887498949) % 1.0  # spread over the clip, never the same twice
        camera, other = camera_of(index), camera_of(index + 1)
        image = drawn.of(lambda: render(prepared, camera, moment, model.background), counted)
        with torch.inference_mode():
            composed = prepared.compose(camera.center, moment)
            settings = RasterSettings(blur=low_pass(composed, camera))
            raster.of(
                lambda: rasterize(composed.gaussians, camera, background, settings=settings, depth=False), counted
            )
        approximated.of(lambda: render(fast.seen_by(camera), camera, moment, model.background), counted)
        orbit.of(lambda: render(prepared, other, moment, model.background), counted)
        encoded.of(lambda: encode_image(np.asarray(image.color), "png"), counted)
        gaussians = max(gaussians, len(composed.gaussians))

    def one_before(index: int, counted: bool) -> None:
        moment = (index * 0.6180339887498949) % 1.0
        camera = camera_of(index)
        with torch.inference_mode():
            expected = unprepared.of(
                lambda: render_composition(model.scene.compose(camera.center, moment), camera, model.background),
                counted,
            )
        found = render(prepared, camera, moment, model.background)
        assert torch.equal(expected.color, found.color), "the prepared scene draws another image"

    def first_view() -> PreparedScene:
        scene = PreparedScene(model.scene)
        render(scene, camera_of(0), 0.123, model.background)
        return scene

    prepared = first.of(first_view)
    started = time.perf_counter()
    fast = FastScene.of(prepared, model.views["train"])
    fast_first_s = time.perf_counter() - started
    for number in range(-WARM_UPS, rounds):
        one_round(number + WARM_UPS, number >= 0)
    for number in range(-1, rounds // 2 if before else -1):
        one_before(number + 1, number >= 0)
    row: dict[str, Any] = {
        "model": name,
        "gaussians": gaussians,
        "px": px,
        "threads": threads,
        "render_ms": drawn.median,
        "rasterize_ms": raster.median,
        "ratio": drawn.median / raster.median,
        "fast_ms": approximated.median,
        "fast_ratio": approximated.median / raster.median,
        "fast_first_s": fast_first_s,
        "encode_ms": encoded.median,
        "fps": 1e3 / drawn.median,
        "orbit_ms": orbit.median,
        "first_ms": first.median,
    }
    if threads == 1:
        row["ratio_cpu"] = statistics.median(drawn.cpu) / statistics.median(raster.cpu)
        row["fast_ratio_cpu"] = statistics.median(approximated.cpu) / statistics.median(raster.cpu)
    if before:
        row |= {"before_ms": unprepared.median, "before_ratio": unprepared.median / raster.median}
        if threads == 1:
            row["before_ratio_cpu"] = statistics.median(unprepared.cpu) / statistics.median(raster.cpu)
    return {key: round(value, 3) if isinstance(value, float) else value for key, value in row.items()}


def png_levels(model: Model, name: str, px: int, rounds: int) -> list[dict[str, Any]]:
    """Size and milliseconds of one image: run lengths, which is the default (None), and levels of deflate."""
    view = next(iter(model.views.values()))[0]
    scene = PreparedScene(model.scene)
    color = render(scene, view.camera.resized(px, px), 0.5, model.background).color.numpy()
    rows = []
    for level in (None, 0, 1, 3, 6, 9):
        times = Times()
        for _ in range(rounds):
            data = times.of(lambda: encode_image(color, "png", png_level=level))  # noqa: B023
        cpu = round(statistics.median(times.cpu), 3)
        rows.append({"model": name, "px": px, "png_level": level, "bytes": len(data), "cpu_ms": cpu})
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
