"""Render precision: error against time when a finished model is rendered.

Sweeps resolution and cut-offs over a few views. The reference is the model's own rendering of the same Gaussians in
float64 and without cut-offs.
"""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor
from torch.nn import functional

from graings import kernel
from graings.camera.camera import View
from graings.capture.capture import Split
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings
from graings.render import draw, render_composition
from graings.report.machine import machine_facts, version_facts
from graings.report.work_precision import pareto
from graings.report.work_precision_document import (
    ImageSize,
    Milliseconds,
    RenderedRun,
    RenderedViews,
    RenderError,
    RenderPart,
    RenderPoint,
    RenderReference,
    RenderSetting,
)
from graings.scene.prepared import PreparedScene
from graings.scene.scene import Composed
from graings.storage.model import Model

VIEWS: Final = 4
WARM_UPS: Final = 2
ROUNDS: Final = 7
MIN_ROUNDS: Final = 2
BUDGET_S: Final = 30.0  # of timing; with large images fewer rounds and fewer views fit into it

SCALES: Final = (0.5, 0.25)
ALPHA_MINS: Final = (1 / 64, 1 / 1024, 1 / 4096, 1e-6)
TRANSMITTANCES: Final = (1e-1, 1e-2, 1e-3, 0.0)

HELD_OUT_FIRST: Final[tuple[Split, ...]] = ("val", "test", "train")

# An alpha below 1e-9 changes no digit of an image in float32, but would extend every footprint over all of it.
EXACT: Final = RasterSettings(alpha_min=1e-9, transmittance_min=0.0)
OMISSIONS: Final = (
    "precision, instruction sets and threads: measured on the kernel alone by benchmarks/raster_precision.py",
    "error against photographs: measured by the held-out evaluation",
)


def settings() -> tuple[RenderSetting, ...]:
    """The default and, one quantity at a time, what differs from it."""
    default = {
        "alpha_min": DEFAULT_SETTINGS.alpha_min,
        "transmittance_min": DEFAULT_SETTINGS.transmittance_min,
    }
    sweeps: dict[str, Sequence[float]] = {
        "scale": SCALES,
        "alpha_min": ALPHA_MINS,
        "transmittance_min": TRANSMITTANCES,
    }
    changed = [
        RenderSetting.model_validate(
            {**default, key: value, "sweep": "resolution" if key == "scale" else key},
        )
        for key, values in sweeps.items()
        for value in values
    ]
    return (RenderSetting(sweep="default", **default), *changed)


def render_part(name: str, model: Model, *, views: int = VIEWS, budget_s: float = BUDGET_S) -> RenderPart:
    """Error of the run `name` against milliseconds of a frame, and the Pareto front.

    Uses held-out views where the model has any, spread evenly. Errors are over all pixels of all views; milliseconds
    are the mean over views, the median over rounds; every round times all settings, so that a slow moment affects all
    of them. Raises `ValueError` for a model without views.
    """
    load = os.getloadavg()[0]
    sweep = settings()
    prepared = PreparedScene(model.scene, kept_times=0)  # every frame counts as one of a new time
    with torch.inference_mode():
        split, chosen = _views(model, prepared, views, budget_s / (len(sweep) * (WARM_UPS + MIN_ROUNDS + 1)))
        frames = [_Frame.of(model, prepared, view) for view in chosen]
        errors = [_error(model, frames, setting) for setting in sweep]
        raster_times, network_times = _times(model, prepared, frames, sweep, budget_s)
    costs = [_milliseconds(times, network_times) for times in raster_times]
    front = pareto([cost.median for cost in costs], [error.rmse for error in errors])
    return RenderPart(
        run=RenderedRun(name=name, iteration=model.iteration, finished=model.finished, digest=model.digest),
        views=RenderedViews(split=split, names=tuple(view.name for view in chosen)),
        size=ImageSize(width=chosen[0].camera.width, height=chosen[0].camera.height),
        reference=RenderReference(
            what="the model's own rendering, Gaussians in float64",
            alpha_min=EXACT.alpha_min,
            transmittance_min=EXACT.transmittance_min,
            norm="root mean square over pixels and channels of images in [0, 1]",
        ),
        rounds=len(network_times),
        noisy=load > 0.5 * kernel.usable_cores() or any(cost.iqr > 0.1 * cost.median for cost in costs),
        load_average=load,
        machine=machine_facts(),
        versions=version_facts(),
        points=tuple(
            RenderPoint(setting=setting, ms=cost, err=error, on_front=index in front)
            for index, (setting, cost, error) in enumerate(zip(sweep, costs, errors, strict=True))
        ),
        pareto=tuple(front),
        omissions=OMISSIONS,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """One view, the Gaussians it shows and its reference image."""

    view: View
    composition: Composed
    reference: Tensor  # [H, W, 3] float64

    @staticmethod
    def of(model: Model, prepared: PreparedScene, view: View) -> _Frame:
        composition = prepared.compose(view.camera.center, view.time)
        names = ("means", "quats", "log_scales", "opacities", "colors")
        double = {name: getattr(composition.gaussians, name).double() for name in names}
        exact = replace(composition, gaussians=replace(composition.gaussians, **double))
        reference = draw(exact, view.camera, model.background, settings=EXACT).color
        return _Frame(view, composition, reference.clamp(0, 1))

    def rendered(self, model: Model, setting: RenderSetting) -> Tensor:
        camera, scale = self.view.camera, setting.scale
        if scale != 1.0:
            camera = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        raster = replace(DEFAULT_SETTINGS, alpha_min=setting.alpha_min, transmittance_min=setting.transmittance_min)
        return render_composition(self.composition, camera, model.background, settings=raster).color


def _views(model: Model, prepared: PreparedScene, count: int, seconds: float) -> tuple[Split, tuple[View, ...]]:
    """At most `count` views that together take about `seconds` to render, but at least one."""
    split = next((split for split in HELD_OUT_FIRST if model.views.get(split)), None)
    if split is None:
        raise ValueError("the model has no views to render")
    views = model.views[split]
    for _ in range(2):  # the first one is slower: caches are cold
        started = time.perf_counter()
        draw(prepared.compose(views[0].camera.center, views[0].time), views[0].camera, model.background)
        duration = time.perf_counter() - started
    number = max(1, min(count, len(views), int(seconds / duration)))
    return split, tuple(views[i * len(views) // number] for i in range(number))


def _error(model: Model, frames: Sequence[_Frame], setting: RenderSetting) -> RenderError:
    """Error of one setting over all frames; a smaller image is scaled up bilinearly."""
    squares, values, largest, changed = 0.0, 0, 0.0, 0
    for frame in frames:
        image = frame.rendered(model, setting).double().clamp(0, 1)
        if image.shape != frame.reference.shape:
            planes = image.permute(2, 0, 1)[None]
            size = frame.reference.shape[:2]
            image = functional.interpolate(planes, size, mode="bilinear", align_corners=False)[0].permute(1, 2, 0)
        difference = image - frame.reference
        squares += float(difference.square().sum())
        values += difference.numel()
        largest = max(largest, float(difference.abs().max()))
        changed += int(((image * 255).round() != (frame.reference * 255).round()).sum())
    mse = squares / values
    return RenderError(
        rmse=mse**0.5,
        max=largest,
        psnr_vs_reference=-10.0 * math.log10(mse) if mse > 0 else None,
        lsb8_changed=changed / values,
    )


def _times(
    model: Model,
    prepared: PreparedScene,
    frames: Sequence[_Frame],
    sweep: Sequence[RenderSetting],
    budget_s: float,
) -> tuple[list[list[float]], list[float]]:
    """Seconds of a frame, mean over `frames`, in each round: to rasterize with each setting, and of the networks."""
    raster_times: list[list[float]] = [[] for _ in sweep]
    network_times: list[float] = []
    for number in _rounds(budget_s):
        started = time.perf_counter()
        for frame in frames:
            prepared.compose(frame.view.camera.center, frame.view.time)
        if number >= 0:
            network_times.append((time.perf_counter() - started) / len(frames))
        for times, setting in zip(raster_times, sweep, strict=True):
            started = time.perf_counter()
            for frame in frames:
                frame.rendered(model, setting)
            if number >= 0:
                times.append((time.perf_counter() - started) / len(frames))
    return raster_times, network_times


def _rounds(budget_s: float) -> Iterator[int]:
    """Numbers of the rounds, negative ones to warm up; beyond the budget only `MIN_ROUNDS`."""
    started = time.perf_counter()
    for number in range(-WARM_UPS, ROUNDS):
        if time.perf_counter() - started < budget_s or 0 <= number < MIN_ROUNDS:
            yield number


def _milliseconds(raster_times: Sequence[float], network_times: Sequence[float]) -> Milliseconds:
    """A whole frame and its two halves.

    The networks compute the same with every setting: all settings get the same median for them, so that their noise
    does not decide between settings. `min` and `iqr` are those of whole frames.
    """
    networks, raster = statistics.median(network_times), statistics.median(raster_times)
    frames = [network_s + raster_s for network_s, raster_s in zip(network_times, raster_times, strict=True)]
    low, _, high = statistics.quantiles(frames, n=4, method="inclusive")
    return Milliseconds(
        median=1e3 * (networks + raster),
        min=1e3 * min(frames),
        iqr=1e3 * max(high - low, 0.0),  # equal times may interpolate to a difference of -1e-18
        networks=1e3 * networks,
        raster=1e3 * raster,
    )
