"""Calibration: how long steps of a tiny synthetic scene take on this machine, measured once and kept."""

from __future__ import annotations

import logging
import tempfile
import time
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

import graings
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import write_synthetic
from graings.config import RatesConfig, TrainConfig, make_config
from graings.kernel import computing_threads, has_bfloat16_products
from graings.plan.cost import (
    CALIBRATION_FILE,
    TERMS,
    Calibration,
    Load,
    cache_folder,
    stored_calibration,
    visible_pixels,
)
from graings.report.machine import machine_facts
from graings.storage.files import write_document
from graings.training.trainer import Trainer

LOG = logging.getLogger(__name__)

WARM_STEPS: Final = 2
TIMED_STEPS: Final = 5
SIZES: Final = (64, 224)
RATE: Final = 1e-12

# Size in px, first anchors, views a step, deformation, residual.
CASES: Final = (
    *((64, 100, 4, True, True), (64, 1_200, 4, True, True), (224, 100, 4, True, True), (224, 1_200, 4, True, True)),
    *((64, 1_200, 4, False, True), (64, 1_200, 4, True, False), (64, 1_200, 4, False, False)),
    *((64, 1_200, 1, True, True), (224, 100, 1, True, True), (64, 1_200, 1, False, False)),
)
BUSIEST: Final = 1  # the case in which networks take most of the time


def calibration(threads: int | None = None, folder: Path | None = None) -> Calibration:
    """The calibration of this machine for `threads` CPU threads (None: all cores), from `folder` or measured now.

    It is kept in `folder` (None: the user's cache folder) and measured again for another version of graings, processor
    or number of threads.
    """
    place = folder or cache_folder()
    kept = kept_calibration(threads, place)
    if kept is not None:
        return kept
    with computing_threads(threads) as count:
        measured = measure_calibration(count)
    try:
        place.mkdir(parents=True, exist_ok=True)
        write_document(place / CALIBRATION_FILE, measured)
    except OSError as error:
        LOG.warning("%s: the times of this machine cannot be kept and are measured each time (%s)", place, error)
    return measured


def kept_calibration(threads: int | None = None, folder: Path | None = None) -> Calibration | None:
    """The calibration that `calibration` would take from `folder`; None where it would measure."""
    kept = stored_calibration(folder)
    with computing_threads(threads) as count:
        same = kept is not None and (kept.cpu, kept.threads) == (machine_facts().cpu, count)
    return kept if same else None


def measure_calibration(threads: int) -> Calibration:
    """Time steps of several sizes and fit the times of their parts."""
    started = time.process_time()
    rows, cpu, wall = [], [], []
    with tempfile.TemporaryDirectory(prefix="graings-") as temporary:
        captures = {size: write_synthetic(Path(temporary) / str(size), frames=8, size=size) for size in SIZES}
        for size, anchors, views, deformation, residual in CASES:
            load, cpu_s, wall_s = _timed(captures[size], _config(anchors, views, deformation, residual))
            rows.append(load.terms())
            cpu.append(cpu_s)
            wall.append(wall_s)
        float32_s = None
        if has_bfloat16_products():
            size, anchors, views, deformation, residual = CASES[BUSIEST]
            _, float32_s, _ = _timed(captures[size], _config(anchors, views, deformation, residual, "float32"))
    seconds = np.array(cpu)
    times = _non_negative(np.array(rows), seconds)
    relative = np.array(rows) @ times / seconds - 1.0
    return Calibration(
        version=graings.__version__,
        cpu=machine_facts().cpu,
        threads=threads,
        **dict(zip(TERMS, times.tolist(), strict=True)),
        float32=1.0 if float32_s is None else _slower(rows[BUSIEST], cpu[BUSIEST], times, float32_s),
        # Other processes only lengthen the wall-clock time; one thread alone takes as long as its CPU time.
        wall_over_cpu=min(1.0, float(np.min(np.array(wall) / seconds))),
        error=float(np.sqrt(np.mean(np.square(relative)))),
        cost_s=time.process_time() - started,
    )


def _slower(load: tuple[float, ...], seconds: float, times: NDArray[np.float64], float32_s: float) -> float:
    """Time of the Gaussians of a load in float32 over that in `seconds`, the CPU seconds in bfloat16; at least 1."""
    gaussians = TERMS.index("gaussian")
    others = float(np.dot(load[:gaussians], times[:gaussians]))
    return max(1.0, (float32_s - others) / max(seconds - others, 1e-9))


def _config(anchors: int, views: int, deformation: bool, residual: bool, precision: str = "auto") -> TrainConfig:
    return make_config(
        "standard",
        {
            "iterations": 30_000,
            "warmup": 0,
            "batch": views,
            "time_window": 1.0,
            "init.points": 50 * anchors,
            "init.max_points": anchors,
            "scene.deformation": "child" if deformation else "none",
            "scene.residual": residual,
            "network_precision": precision,
            "density.statistics_from": 0,
            # All children stay drawn, as nearly all of a trained scene are: the first steps would make them fade.
            "rates": dict.fromkeys(RatesConfig.model_fields, (RATE, RATE)),
        },
    )


def _timed(capture: Path, config: TrainConfig) -> tuple[Load, float, float]:
    """The load of a step, and its median CPU and wall-clock seconds."""
    data = load_capture(capture, config.capture)
    images = ImageStore(config.capture.background_rgb())
    trainer = Trainer.start(data, images, config)
    steps = [trainer.step() for _ in range(WARM_STEPS + TIMED_STEPS)][WARM_STEPS:]
    camera = data.train[0].camera
    coverage = float(np.mean([(images.rgb(frame).min(-1) < 0.99).mean() for frame in data.train]))
    load = Load(
        views=config.batch,
        pixels=visible_pixels(camera.width * camera.height, coverage),
        gaussians=float(np.median([step.gaussians for step in steps])),
        deformation=config.scene.deformation != "none",
        residual=config.scene.residual,
    )
    return load, float(np.median([s.cpu_s for s in steps])), float(np.median([s.seconds for s in steps]))


def _non_negative(rows: NDArray[np.float64], seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least squares of relative errors with no negative time: columns that come out negative are left out in turn."""
    times = np.zeros(rows.shape[1])
    scaled, columns = rows / seconds[:, None], list(range(rows.shape[1]))
    while columns:
        solution = np.linalg.lstsq(scaled[:, columns], np.ones(len(seconds)), rcond=None)[0]
        if (solution >= 0).all():
            times[columns] = solution
            break
        columns.pop(int(solution.argmin()))
    return times
