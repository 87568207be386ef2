"""Captures, training and evaluation in a program: a part of the Python interface, `graings.api`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from graings.capture.capture import Capture, Split
from graings.capture.load import load_capture as read_capture
from graings.capture.synthetic import synthesize as write_scene
from graings.config import CaptureConfig, make_config
from graings.errors import ConfigError
from graings.evaluation.metrics import SplitMetrics
from graings.kernel.threads import usable_cores
from graings.report.evaluate_run import evaluate_run as evaluate_and_record
from graings.training.run import TrainingRun
from graings.training.run_output import RunReport

FilePath = str | PathLike[str]


def synthesize(name: str, folder: FilePath, *, size: int = 400, views: int = 150, seed: int = 0) -> Path:
    """Write the synthetic scene `name` as a capture of `views` training images of `size` px; returns its folder.

    Raises `ValueError` with the names that exist.
    """
    write_scene(name, Path(folder), size=size, views=views, seed=seed, processes=usable_cores())
    return Path(folder)


def load_capture(folder: FilePath) -> Capture:
    """Read a capture: views with cameras and times by split, units, notes on what was found. Raises `CaptureError`."""
    return read_capture(Path(folder), CaptureConfig())


def train(
    capture: FilePath,
    run: FilePath,
    *,
    preset: str | None = None,
    options: Mapping[str, Any] | None = None,
    observe: Callable[[RunReport], None] = lambda step: None,
) -> Path:
    """Train on the capture and write the model, metrics and plots into the folder `run`, which is returned.

    `options` are those of `graings options`, such as `{"iterations": 500, "capture.max_side": 400}`. The preset may be
    one of them; by default it is `standard`. `observe` is called after every iteration. A program that wants to stop
    and resume iterates over a `TrainingRun` itself. Raises `CaptureError`, `ConfigError`, `CheckpointError` where `run`
    holds a run already, and `DivergedError`.
    """
    overrides = dict(options or {})
    if preset is not None:
        if overrides.get("preset", preset) != preset:
            raise ConfigError(f"preset: is {preset}, and in options {overrides['preset']}. Give one of them.")
        overrides["preset"] = preset
    config = make_config(overrides=overrides)
    training = TrainingRun.create(Path(capture), Path(run), config)
    for step in training:
        observe(step)
    return training.folder


def evaluate_run(run: FilePath, split: Split = "test") -> SplitMetrics:
    """PSNR, SSIM and more on held-out views, also written into the run's `metrics.json`.

    Values are None, with a `reason`, where the capture has no such views. Raises `CheckpointError` where there is no
    model, and `CaptureError` for a capture that cannot be read.
    """
    return evaluate_and_record(Path(run), split)
