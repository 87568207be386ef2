"""What image error buys what time: cut-offs, resolution, precision, threads and instruction sets of the rasterizer.

    python benchmarks/raster_precision.py --yardstick DIR -o FOLDER [--gaussians 50000] [--size 400] [--rounds 9]

DIR holds `bench_scene.py` (see rasterize.py); needs the extra `bench`. The reference is the kernel in float64 without
cut-offs, itself checked against the torch oracle on a small scene. Writes FOLDER/raster_precision.json (schema
graings.work_precision/1, kinds render and kernel) and FOLDER/raster_precision.svg: error against milliseconds of a
frame, and against nanoseconds per pair of pixel and Gaussian, with the Pareto fronts; prints one line a point.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import scenes
import torch
from matplotlib import pyplot
from torch import Tensor
from torch.nn import functional

from graings import kernel
from graings.camera.camera import Camera
from graings.gaussians import Gaussians
from graings.kernel import use_threads
from graings.raster import reference
from graings.raster.rasterize import rasterize
from graings.raster.result import RasterSettings
from graings.report.machine import machine_facts, version_facts

ALPHA_MINS = (1 / 64, 1 / 255, 1 / 512, 1 / 1024, 1 / 4096, 1e-6)
TRANSMITTANCES = (1e-2, 1e-3, 1e-4, 1e-6, 0.0)
EXACT = RasterSettings(alpha_min=1e-9, transmittance_min=0.0)
DEFAULT = RasterSettings()
EXACTLY = 1e-17


@dataclass(frozen=True)
class Point:
    """One way to draw the picture: what it costs and how wrong it is."""

    group: str
    label: str
    ms: float
    ms_min: float
    rmse: float
    worst: float
    changed: float  # share of 8-bit values that differ from the reference

    def to_json(self) -> dict[str, Any]:
        return {
            "setting": {"group": self.group, "label": self.label},
            "ms": {"median": self.ms, "min": self.ms_min},
            "err": {"rmse": self.rmse, "max": self.worst, "lsb8_changed": self.changed},
        }


def cast(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    names = ("means", "quats", "log_scales", "opacities", "colors")
    return replace(gaussians, **{name: getattr(gaussians, name).to(dtype) for name in names})


def scaled(camera: Camera, factor: float) -> Camera:
    return Camera(
        camera.world_to_camera, camera.fx * factor, camera.fy * factor, camera.cx * factor, camera.cy * factor,
        round(camera.width * factor), round(camera.height * factor),
    )  # fmt: skip


class Bench:
    """One scene and camera, with the picture everything is compared with."""

    def __init__(self, generator: Any, count: int, size: int, rounds: int) -> None:
        raw, view = generator.make_scene(count), generator.camera(size)
        values = {name: torch.from_numpy(raw[name]) for name in ("means", "quats", "opacities", "colors")}
        self.gaussians = Gaussians(**values, log_scales=torch.from_numpy(raw["scales"]).log(), uids=torch.arange(count))
        self.camera = Camera(view["viewmat"], view["fx"], view["fy"], view["cx"], view["cy"], view["W"], view["H"])
        self.rounds = rounds
        double = cast(self.gaussians, torch.float64)
        self.truth = rasterize(double, self.camera, torch.zeros(3, dtype=torch.float64), settings=EXACT).color
        leaf = self.gaussians.means.clone().requires_grad_()
        drawn: Any = rasterize(replace(self.gaussians, means=leaf), self.camera, torch.zeros(3)).color.grad_fn
        self.pairs = int(drawn.frame.evaluated)

    def point(
        self, group: str, label: str, *, settings: RasterSettings = DEFAULT, dtype: torch.dtype = torch.float32,
        factor: float = 1.0, threads: int | None = None,
    ) -> Point:  # fmt: skip
        """Time and error of one setting; pictures of another resolution are scaled back bilinearly."""
        use_threads(threads)
        gaussians, camera = cast(self.gaussians, dtype), scaled(self.camera, factor)
        background = torch.zeros(3, dtype=dtype)
        times = []
        for _ in range(self.rounds + 2):
            started = time.perf_counter()
            color = rasterize(gaussians, camera, background, settings=settings).color
            times.append(1e3 * (time.perf_counter() - started))
        image = self._full_size(color.double())
        difference = image - self.truth
        changed = ((image * 255).round() != (self.truth * 255).round()).double().mean()
        return Point(
            group, label, statistics.median(times[2:]), min(times[2:]), float(difference.square().mean().sqrt()),
            float(difference.abs().max()), float(changed),
        )  # fmt: skip

    def _full_size(self, color: Tensor) -> Tensor:
        if color.shape == self.truth.shape:
            return color
        planes = color.permute(2, 0, 1)[None]
        back = functional.interpolate(planes, self.truth.shape[:2], mode="bilinear", align_corners=False)
        return back[0].permute(1, 2, 0)


def floor(generator: Any) -> float:
    """Largest difference of the reference to the torch oracle, on a small scene."""
    small = Bench(generator, 300, 64, 1)
    double = cast(small.gaussians, torch.float64)
    oracle = reference.rasterize(double, small.camera, torch.zeros(3, dtype=torch.float64), settings=EXACT).color
    return float((oracle - small.truth).abs().max())


def pareto(points: list[Point]) -> list[Point]:
    """Those that no other beats in both time and error, by time."""
    front: list[Point] = []
    for point in sorted(points, key=lambda p: (p.ms, p.rmse)):
        if not front or point.rmse < front[-1].rmse:
            front.append(point)
    return front


def shown(rmse: float) -> float:
    """Where an error is drawn: a logarithmic axis has no place for the reference itself."""
    return max(rmse, EXACTLY)


def draw(axis: Any, points: list[Point], title: str, xlabel: str, scale: float) -> None:
    for group in dict.fromkeys(point.group for point in points):
        mine = [point for point in points if point.group == group]
        line = axis.loglog(
            [p.ms * scale for p in mine], [shown(p.rmse) for p in mine], marker="o", markersize=4, linewidth=1
        )
        line[0].set_label(group)
    front = pareto(points)
    axis.step(
        [p.ms * scale for p in front],
        [shown(p.rmse) for p in front],
        where="post",
        color="0.75",
        linewidth=4,
        zorder=0,
        label="Pareto front",
    )
    axis.set(title=title, xlabel=xlabel, ylabel=f"RMSE against float64 without cut-offs ({EXACTLY:.0e}: none)")
    axis.margins(0.2, 0.12)
    axis.grid(True, which="major", color="0.92")
    axis.legend(fontsize=8, frameon=False)


def label(axis: Any, points: list[Point], scale: float) -> None:
    """Names the points once the axes have their size: those that lie on each other share a label, none covers one."""
    places = axis.transData.transform([(p.ms * scale, shown(p.rmse)) for p in points])
    clusters: list[tuple[Any, list[str]]] = []
    for place, point in zip(places, points, strict=True):
        near = next((names for other, names in clusters if abs(other - place).max() < 9), None)
        name = f"{point.group} {point.label}"
        if near is None:
            clusters.append((place, [name]))
        elif name not in near:
            near.append(name)
    taken: list[tuple[float, float, float]] = []
    for (x, y), names in sorted(clusters, key=lambda cluster: float(cluster[0][1])):
        text = ", ".join(names if len(names) < 4 else [*names[:2], f"{len(names) - 2} more"])
        low, width = y + 5, 4.4 * len(text)
        while any(abs(low - other) < 10 and x < right and left < x + width for left, other, right in taken):
            low += 10
        taken.append((x, low, x + width))
        note = axis.annotate(
            text, axis.transData.inverted().transform((x, y)), xytext=(4, (low - y) * 0.72), textcoords="offset points",
            fontsize=6.5, color="0.3", arrowprops={"arrowstyle": "-", "color": "0.8", "linewidth": 0.5},
        )  # fmt: skip
        note.set_in_layout(False)


def _part(kind: str, points: list[Point]) -> dict[str, Any]:
    front = [f"{point.group} {point.label}" for point in pareto(points)]
    return {"kind": kind, "points": [point.to_json() for point in points], "pareto": front}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--yardstick", type=Path, required=True)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args()
    generator = scenes.module_of(options.yardstick, "bench_scene")
    if generator is None:
        parser.error(f"{options.yardstick / 'bench_scene.py'} not found: give its folder with --yardstick")
    disagreement = floor(generator)
    print(f"reference against oracle: {disagreement:.1e}")
    bench = Bench(generator, options.gaussians, options.size, options.rounds)
    cores = kernel.usable_cores()
    render = [
        bench.point("alpha_min", f"{a:.1e}", settings=replace(DEFAULT, alpha_min=a), threads=cores) for a in ALPHA_MINS
    ]
    render += [
        bench.point("T_min", f"{t:.0e}", settings=replace(DEFAULT, transmittance_min=t), threads=cores)
        for t in TRANSMITTANCES
    ]
    render += [bench.point("resolution", f"1/{n}", factor=1 / n, threads=cores) for n in (1, 2, 4)]
    render.append(bench.point("default", "default", threads=cores))
    variants = []
    for isa in kernel.available_isas():
        kernel.use_isa(isa)
        for dtype, name in ((torch.float32, "f32"), (torch.float64, "f64")):
            for threads in dict.fromkeys((1, cores)):
                variants.append(bench.point(isa, f"{name}, {threads} thr", dtype=dtype, threads=threads))
                variants.append(
                    bench.point(
                        f"{isa}, no cut-offs", f"{name}, {threads} thr", dtype=dtype, settings=EXACT, threads=threads
                    )
                )
    kernel.use_isa(kernel.available_isas()[0])
    for point in (*render, *variants):
        print(
            f"{point.group:<22} {point.label:<14} {point.ms:8.2f} ms  rmse {point.rmse:.2e}  max {point.worst:.2e}  "
            f"8-bit changed {point.changed:.2%}"
        )
    figure, axes = pyplot.subplots(1, 2, figsize=(16, 8), layout="constrained")
    draw(axes[0], render, "A frame", "milliseconds", 1.0)
    draw(
        axes[1],
        variants,
        "The kernel",
        "nanoseconds per pair of pixel and Gaussian that the default evaluates",
        1e6 / bench.pairs,
    )
    figure.canvas.draw()
    label(axes[0], render, 1.0)
    label(axes[1], variants, 1e6 / bench.pairs)
    figure.suptitle(f"Error against time, {options.gaussians:,} Gaussians at {options.size} px")
    options.output.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.output / "raster_precision.svg")
    document = {
        "schema": "graings.work_precision/1",
        "machine": machine_facts().to_json(),
        "versions": version_facts().to_json(),
        "reference": {"what": "float64, no cut-offs", "floor": disagreement},
        "scene": {"gaussians": options.gaussians, "size": options.size, "pairs": bench.pairs},
        "render": _part("render", render),
        "kernel": _part("kernel", variants),
        "omissions": ["variants of the exponential and of the backward pass: the kernel has one of each"],
    }
    (options.output / "raster_precision.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
