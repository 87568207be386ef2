"""Cost: CPU seconds of a training, predicted from the capture, the options and a calibration of this machine.

A step takes a constant time, and times proportional to the visible pixels and to the Gaussians drawn, per step and per
view. The calibration (`graings.training.calibration` measures it) holds these times; the number of Gaussians follows
from the detail of the images.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field

import graings
from graings.config import TrainConfig
from graings.document import Document
from graings.plan.capture_statistics import CaptureStatistics

CALIBRATION_FILE: Final = "calibration.json"

Seconds = Annotated[float, Field(ge=0)]

# Anchors of a finished model for each pixel with detail of one view. Measured with `standard` at 400 px: jumpingjacks
# 0.43, standup 0.43, bouncingballs 0.49, hook 0.41 (docs/experiments/). While anchors grow there are more.
ANCHORS_PER_DETAIL: Final = 0.43
DRAWN_CHILDREN: Final = 0.94  # share of the children of all anchors that are drawn in a step
INITIAL_DRAWN: Final = 0.45  # the same before the first growth: most of the first anchors show nothing
# A pixel that shows background takes this share of the time of one that shows something.
BACKGROUND_PIXEL: Final = 0.3


class Calibration(Document):
    """Times of training on this machine, from steps of a tiny synthetic scene."""

    schema_name: Literal["graings.calibration/1"] = Field(
        "graings.calibration/1", alias="schema", description="Kind and version of this document."
    )
    version: str = Field(description="Version of graings.")
    cpu: str = Field(description="Model name of the processor.")
    threads: int = Field(gt=0, description="CPU threads of the steps.")
    step: Seconds = Field(description="CPU seconds of a step without Gaussians and pixels.")
    view: Seconds = Field(description="CPU seconds of a view of a step without Gaussians and pixels.")
    pixel: Seconds = Field(description="CPU seconds of a million visible pixels.")
    gaussian: Seconds = Field(description="CPU seconds of a million Gaussians drawn, once a step.")
    gaussian_view: Seconds = Field(description="CPU seconds of a million Gaussians drawn, once a view.")
    deformation: Seconds = Field(description="Further CPU seconds of the deformation, once a step, of a million.")
    deformation_view: Seconds = Field(description="The same, once a view.")
    residual_view: Seconds = Field(description="Further CPU seconds of the residual, once a view, of a million.")
    float32: float = Field(
        gt=0,
        description="Times of Gaussians with the networks' products in float32, over these; 1 where these are that.",
    )
    wall_over_cpu: float = Field(gt=0, description="Wall-clock time of a step over its CPU time.")
    error: float = Field(ge=0, description="Root mean square relative error of these times on the calibrating steps.")
    cost_s: Seconds = Field(description="CPU seconds that the calibration took.")


class Prediction(Document):
    """Expected cost of a training, and what it was."""

    cpu_s: Seconds = Field(description="CPU seconds of all steps, of all threads.")
    minutes: float = Field(ge=0, description="Wall-clock minutes of all steps on an otherwise idle machine.")
    threads: int = Field(gt=0, description="CPU threads that the calibration had.")
    gaussians: int = Field(ge=0, description="Gaussians expected to be drawn in a view near the end.")
    actual_cpu_s: Seconds | None = Field(None, description="CPU seconds that the steps took; null before the end.")
    error: float | None = Field(
        None,
        description="Predicted over actual CPU seconds, minus 1; null before the end.",
    )

    def compared(self, actual_cpu_s: float) -> Prediction:
        """With the CPU seconds that the training took."""
        return self.model_copy(
            update={"actual_cpu_s": actual_cpu_s, "error": self.cpu_s / max(actual_cpu_s, 1e-9) - 1.0}
        )


@dataclass(frozen=True, slots=True)
class Load:
    """What a step computes: `views` of `pixels` visible pixels each and `gaussians` drawn."""

    views: int
    pixels: float
    gaussians: float
    deformation: bool
    residual: bool

    def terms(self) -> tuple[float, ...]:
        """Factors of the times of a calibration, in the order of `TERMS`."""
        millions, moving, changing = 1e-6 * self.gaussians, float(self.deformation), float(self.residual)
        return (
            *(1.0, float(self.views), self.views * self.pixels * 1e-6),
            *(millions, self.views * millions, moving * millions, moving * self.views * millions),
            changing * self.views * millions,
        )


TERMS: Final = (
    *("step", "view", "pixel", "gaussian", "gaussian_view", "deformation", "deformation_view", "residual_view"),
)


def visible_pixels(pixels: float, coverage: float) -> float:
    """`pixels` of which the share `coverage` shows something, in pixels that take the time of a visible one."""
    return pixels * (coverage + BACKGROUND_PIXEL * (1.0 - coverage))


def predict(statistics: CaptureStatistics, config: TrainConfig, calibration: Calibration) -> Prediction:
    """The cost of training with `config`, in which what the plan drops is already left out.

    Steps only: making the first anchors is not part of it.
    """
    slower = calibration.float32 if config.network_precision == "float32" else 1.0
    loads = _loads(statistics, config)
    cpu_s = sum(steps * _seconds(calibration, load, slower) for steps, load in loads)
    return Prediction(
        cpu_s=cpu_s,
        minutes=cpu_s * calibration.wall_over_cpu / 60.0,
        threads=calibration.threads,
        gaussians=round(loads[-1][1].gaussians),
    )


def _seconds(calibration: Calibration, load: Load, slower: float) -> float:
    load = replace(load, gaussians=slower * load.gaussians)
    return sum(getattr(calibration, name) * factor for name, factor in zip(TERMS, load.terms(), strict=True))


def expected_anchors(statistics: CaptureStatistics) -> int:
    """Anchors that the detail of the images asks for, without any limit."""
    return max(16, round(ANCHORS_PER_DETAIL * statistics.detail * statistics.pixels))


def _loads(statistics: CaptureStatistics, config: TrainConfig) -> Sequence[tuple[int, Load]]:
    """Parts of the training: number of steps, and the load of each. Gaussians are those of one view."""
    children, most = config.scene.children, config.init.max_points
    budget = config.density.max_anchors or expected_anchors(statistics) + statistics.points  # no budget: nothing binds
    first = min(most, budget, statistics.points) if statistics.points else most
    last = min(expected_anchors(statistics), budget)
    pixels = visible_pixels(statistics.pixels, statistics.coverage)
    views = min(config.batch, statistics.images)
    temporal = config.scene.deformation != "none" or config.scene.residual
    marks = {
        0,
        config.iterations,
        config.scaled(config.warmup) if temporal else 0,
        min(config.iterations, config.scaled(config.density.grow_from)),
        min(config.iterations, config.scaled(config.low_resolution_until)),
    }
    reduced = max(statistics.width, statistics.height) >= 400
    loads = []
    for begin, end in pairwise(sorted(marks)):
        small = reduced and end <= config.scaled(config.low_resolution_until)
        grown = begin >= config.scaled(config.density.grow_from)
        joint = temporal and begin >= config.scaled(config.warmup)
        gaussians = last * children * DRAWN_CHILDREN if grown else max(first * INITIAL_DRAWN, last / 2) * children
        load = Load(
            views=views,
            pixels=pixels / 4 if small else pixels,
            gaussians=gaussians,
            deformation=joint and config.scene.deformation != "none",
            residual=joint and config.scene.residual,
        )
        loads.append((end - begin, load))
    return loads


def cache_folder() -> Path:
    """Where measurements of this machine are kept: `graings` in the user's cache folder (XDG_CACHE_HOME)."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base else Path.home() / ".cache") / "graings"


def stored_calibration(folder: Path | None = None) -> Calibration | None:
    """The calibration kept in `folder` (None: the cache folder); None without one, or with one of another version."""
    file = (folder or cache_folder()) / CALIBRATION_FILE
    try:
        stored = Calibration.model_validate_json(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None  # it is measured again when a plan is asked for
    return stored if stored.version == graings.__version__ else None
