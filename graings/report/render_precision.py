"""RenderPrecision: how much picture error buys how much time when a finished model is drawn.

Sweeps resolution and cut-offs over a handful of views. The reference is the model's own picture: the same Gaussians,
in float64 and without cut-offs. Knows nothing of photographs, drawings or files.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import torch
from torch import Tensor
from torch.nn import functional

from graings import kernel
from graings.camera.camera import View
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings
from graings.render import draw, render_composition
from graings.report.machine import machine_facts, version_facts
from graings.report.work_precision import pareto
from graings.scene.scene import Composition
from graings.storage.model import Model

VIEWS: Final = 4
WARM_UPS: Final = 2
ROUNDS: Final = 7
LEAST_ROUNDS: Final = 2
BUDGET_S: Final = 30.0  # of timing; large pictures are drawn less often, and fewer of them

SCALES: Final = (0.5, 0.25)
ALPHA_MINS: Final = (1 / 64, 1 / 1024, 1 / 4096, 1e-6)
TRANSMITTANCES: Final = (1e-1, 1e-2, 1e-3, 0.0)

# Below 1e-9 a Gaussian changes no digit of a picture in single precision, but would cover all of it.
EXACT: Final = RasterSettings(alpha_min=1e-9, transmittance_min=0.0)
OMISSIONS: Final = (
    "precision, instruction sets and threads: measured on the kernel alone by benchmarks/raster_precision.py",
    "error against photographs: part of the held-out evaluation",
)


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to draw: `scale` is a share of the width and height."""

    sweep: str
    scale: float = 1.0
    raster: RasterSettings = DEFAULT_SETTINGS

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "sweep": self.sweep,
            "scale": self.scale,
            "alpha_min": self.raster.alpha_min,
            "transmittance_min": self.raster.transmittance_min,
        }


def settings() -> tuple[Setting, ...]:
    """The default and, one quantity at a time, what differs from it."""
    return (
        Setting("default"),
        *(Setting("resolution", scale) for scale in SCALES),
        *(Setting("alpha_min", 1.0, replace(DEFAULT_SETTINGS, alpha_min=a)) for a in ALPHA_MINS),
        *(Setting("transmittance_min", 1.0, replace(DEFAULT_SETTINGS, transmittance_min=t)) for t in TRANSMITTANCES),
    )


def render_part(name: str, model: Model, *, views: int = VIEWS, budget_s: float = BUDGET_S) -> dict[str, Any]:
    """The run `name` as a part of kind `render`: error against milliseconds of a frame, and the Pareto front.

    Held-out views where the model knows any, spread evenly. Errors are over all pixels of all views; milliseconds are
    the mean over views, the median over rounds; every round times all settings, so that a slow moment hits them all.
    Raises `ValueError` for a model without views.
    """
    load = os.getloadavg()[0]
    ways = settings()
    with torch.inference_mode():
        split, chosen = _views(model, views, budget_s / (len(ways) * (WARM_UPS + LEAST_ROUNDS + 1)))
        scenes = [_Frame.of(model, view) for view in chosen]
        errors = [_error(model, scenes, way) for way in ways]
        rounds, times, networks = _times(model, scenes, ways, budget_s)
    points: list[dict[str, Any]] = [
        {"setting": way.to_json(), "ms": _milliseconds(taken, networks), "err": error}
        for way, taken, error in zip(ways, times, errors, strict=True)
    ]
    front = pareto([p["ms"]["median"] for p in points], [p["err"]["rmse"] for p in points])
    for i, point in enumerate(points):
        point["on_front"] = i in front
    noisy = load > 0.5 * kernel.usable_cores() or any(p["ms"]["iqr"] > 0.1 * p["ms"]["median"] for p in points)
    return {
        "kind": "render",
        "run": {"name": name, "iteration": model.iteration, "finished": model.finished, "digest": model.digest},
        "views": {"split": split, "names": [view.name for view in chosen]},
        "size": {"width": chosen[0].camera.width, "height": chosen[0].camera.height},
        "reference": {
            "what": "the model's own picture, Gaussians in float64",
            "alpha_min": EXACT.alpha_min,
            "transmittance_min": EXACT.transmittance_min,
            "norm": "root mean square over pixels and channels of pictures in [0, 1]",
        },
        "rounds": rounds,
        "noisy": noisy,
        "load_average": load,
        "machine": machine_facts(),
        "versions": version_facts(),
        "points": points,
        "pareto": front,
        "omissions": list(OMISSIONS),
    }


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    view: View
    composition: Composition
    truth: Tensor  # [H, W, 3] float64

    @staticmethod
    def of(model: Model, view: View) -> _Frame:
        composition = model.scene.compose(view.camera.center, view.time)
        names = ("means", "quats", "log_scales", "opacities", "colors")
        double = {name: getattr(composition.gaussians, name).double() for name in names}
        exact = replace(composition, gaussians=replace(composition.gaussians, **double))
        truth = draw(exact, view.camera, model.background, settings=EXACT).color
        return _Frame(view, composition, truth.clamp(0, 1))

    def drawn(self, model: Model, way: Setting) -> Tensor:
        camera = self.view.camera
        if way.scale != 1.0:
            camera = camera.resized(max(1, round(camera.width * way.scale)), max(1, round(camera.height * way.scale)))
        return render_composition(self.composition, camera, model.background, settings=way.raster).color


def _views(model: Model, count: int, seconds: float) -> tuple[str, tuple[View, ...]]:
    """At most `count` views, of which all together take about `seconds` to draw, but at least one."""
    split = next((split for split in ("val", "test", "train") if model.views.get(split)), None)
    if split is None:
        raise ValueError("the model knows no views to draw")
    views = model.views[split]
    for _ in range(2):  # the first is slower: it touches everything for the first time
        started = time.perf_counter()
        draw(model.scene.compose(views[0].camera.center, views[0].time), views[0].camera, model.background)
        taken = time.perf_counter() - started
    number = max(1, min(count, len(views), int(seconds / taken)))
    return split, tuple(views[i * len(views) // number] for i in range(number))


def _error(model: Model, frames: Sequence[_Frame], way: Setting) -> dict[str, Any]:
    """How far the pictures of one setting are from the reference; a smaller picture is scaled up bilinearly."""
    squares, values, worst, changed = 0.0, 0, 0.0, 0
    for frame in frames:
        image = frame.drawn(model, way).double().clamp(0, 1)
        if image.shape != frame.truth.shape:
            planes = image.permute(2, 0, 1)[None]
            size = frame.truth.shape[:2]
            image = functional.interpolate(planes, size, mode="bilinear", align_corners=False)[0].permute(1, 2, 0)
        difference = image - frame.truth
        squares += float(difference.square().sum())
        values += difference.numel()
        worst = max(worst, float(difference.abs().max()))
        changed += int(((image * 255).round() != (frame.truth * 255).round()).sum())
    mse = squares / values
    return {
        "rmse": mse**0.5,
        "max": worst,
        "psnr_vs_reference": -10.0 * float(torch.tensor(mse, dtype=torch.float64).log10()) if mse > 0 else None,
        "lsb8_changed": changed / values,
    }


def _times(
    model: Model, frames: Sequence[_Frame], ways: Sequence[Setting], budget_s: float
) -> tuple[int, list[list[float]], list[float]]:
    """Rounds made, and per round the seconds of a frame: rasterized in each way, and composed by the networks."""
    times: list[list[float]] = [[] for _ in ways]
    networks: list[float] = []
    for done in _rounds(budget_s):
        started = time.perf_counter()
        for frame in frames:
            model.scene.compose(frame.view.camera.center, frame.view.time)
        if done >= 0:
            networks.append((time.perf_counter() - started) / len(frames))
        for taken, way in zip(times, ways, strict=True):
            started = time.perf_counter()
            for frame in frames:
                frame.drawn(model, way)
            if done >= 0:
                taken.append((time.perf_counter() - started) / len(frames))
    return len(networks), times, networks


def _rounds(budget_s: float) -> Iterator[int]:
    """Numbers of the rounds to make, negative ones to warm up; beyond the budget only the least."""
    started = time.perf_counter()
    for done in range(-WARM_UPS, ROUNDS):
        if time.perf_counter() - started < budget_s or 0 <= done < LEAST_ROUNDS:
            yield done


def _milliseconds(raster: Sequence[float], networks: Sequence[float]) -> dict[str, float]:
    """A whole frame and its two halves.

    The networks do the same whatever is drawn: every setting gets the same median for them, so that their noise
    decides nothing between settings. `min` and `iqr` are those of whole frames.
    """
    composed, drawn = statistics.median(networks), statistics.median(raster)
    frames = [one + other for one, other in zip(networks, raster, strict=True)]
    low, _, high = statistics.quantiles(frames, n=4, method="inclusive")
    return {
        "median": 1e3 * (composed + drawn),
        "min": 1e3 * min(frames),
        "iqr": 1e3 * (high - low),
        "networks": 1e3 * composed,
        "raster": 1e3 * drawn,
    }
