"""HeldOut: one pass over views of a run, each drawn once: quality, rendering speed and footprints."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.evaluation.metrics import Pair, SplitMetrics, measure_split
from graings.evaluation.perceptual import PerceptualDistances
from graings.render import render_composition
from graings.scene.prepared import PreparedScene
from graings.scene.scene import Scene
from graings.training.guard.stiffness import SubpixelCounter


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """What one pass over some views measured.

    `frames_per_second` is the median over the views but the first, without encoding and without preparing the scene;
    `subpixel_share` is f_sub of these views (`graings.training.guard.stiffness`).
    """

    metrics: SplitMetrics
    frames_per_second: float
    subpixel_share: float | None

    @staticmethod
    def measure(
        scene: Scene,
        frames: Sequence[Frame],
        images: ImageStore,
        background: Sequence[float],
        distances: PerceptualDistances | None = None,
    ) -> HeldOut:
        """Draw each of at least one view in `frames` once."""
        footprints, seconds = SubpixelCounter(scene), list[float]()
        prepared = PreparedScene(scene, kept_times=0)  # every view counts as one of a new time

        def pairs() -> Iterator[Pair]:
            for frame in frames:
                started = time.perf_counter()
                with torch.inference_mode():
                    composition = prepared.compose(frame.camera.center, frame.time)
                    result = render_composition(composition, frame.camera, background)
                seconds.append(time.perf_counter() - started)
                footprints.add(composition, result.radii, frame.camera)
                color = result.color.clamp(0, 1).numpy()
                yield Pair(frame.name, frame.time, color, images.rgb(frame), images.valid(frame))

        metrics = measure_split(pairs(), distances)
        fps = 1.0 / max(statistics.median(seconds[1:] or seconds), 1e-9)
        return HeldOut(metrics, fps, footprints.share())
