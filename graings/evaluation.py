"""Evaluation: how close rendered views come to held-out images.

Knows nothing of training.
"""

from __future__ import annotations

import hashlib
import statistics
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from numpy.typing import ArrayLike

from graings.capture.capture import Frame, Split
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.compact import open_model
from graings.errors import CheckpointError
from graings.metrics import Lpips, SplitMetrics, measure_split
from graings.render import render
from graings.report import read_metrics, write_metrics
from graings.run_folder import read_record
from graings.scene.scene import Scene


def evaluate(
    scene: Scene,
    frames: Sequence[Frame],
    images: ImageStore,
    background: Sequence[float],
    *,
    lpips: Lpips | None = None,
) -> SplitMetrics:
    """Metrics of `scene` on `frames`: each view rendered at its own camera and time."""

    def pairs() -> Iterator[tuple[str, float, ArrayLike, ArrayLike]]:
        for frame in frames:
            rendered = render(scene, frame.camera, frame.time, background)
            yield frame.name, frame.time, rendered.color.clamp(0, 1).numpy(), images.rgb(frame)

    return measure_split(pairs(), lpips)


def subset(frames: Sequence[Frame], size: int) -> tuple[Frame, ...]:
    """At most `size` frames chosen by the hash of their names: fixed for a capture, spread over it."""
    if len(frames) <= size:
        return tuple(frames)
    order = sorted(range(len(frames)), key=lambda i: hashlib.sha256(frames[i].name.encode()).digest())
    return tuple(frames[i] for i in sorted(order[:size]))


def frames_per_second(scene: Scene, frames: Sequence[Frame], background: Sequence[float]) -> float:
    """Median speed of rendering `frames` at their size after one to warm up, networks included."""
    seconds = []
    for frame in (frames[0], *frames):
        started = time.perf_counter()
        render(scene, frame.camera, frame.time, background)
        seconds.append(time.perf_counter() - started)
    return 1.0 / max(statistics.median(seconds[1:]), 1e-9)


def evaluate_run(
    run: Path, split: Split, capture: Path | None = None, background: Sequence[float] | None = None
) -> SplitMetrics:
    """Evaluate the newest model of a run on one split and write the result into its `metrics.json`.

    The capture is found where it was at training time unless given. On another `background` [3] than training's,
    which says whether opaque things are so and empty space is empty, nothing is written. Raises `CheckpointError` when
    the run has no model or the capture is not the one it was trained on.
    """
    model = open_model(run)
    record = read_record(run)
    data = load_capture(capture or record.capture, model.config.capture)
    if data.content_hash != record.capture_hash:
        raise CheckpointError(
            f"{data.root}: not the capture this run was trained on. Give the original with --capture."
        )
    frames = data.split(split)
    behind = model.background if background is None else background
    images = ImageStore(behind, model.config.capture.cache_mb)
    metrics = evaluate(model.scene, frames, images, behind, lpips=Lpips.find())
    if background is not None:
        return metrics
    document = read_metrics(run / "metrics.json")
    if not isinstance(document.get("splits"), dict):
        raise CheckpointError(f"{run / 'metrics.json'}: has no `splits`. Finish the training run again (--resume).")
    document["splits"][split] = metrics.to_json()
    write_metrics(run / "metrics.json", document)
    return metrics
