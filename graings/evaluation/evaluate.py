"""Evaluation: how close rendered views come to held-out images."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence

from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.evaluation.metrics import Pair, SplitMetrics, measure_split
from graings.evaluation.perceptual import PerceptualDistances
from graings.render import render
from graings.scene.prepared import PreparedScene
from graings.scene.scene import Scene


def evaluate(
    scene: Scene,
    frames: Sequence[Frame],
    images: ImageStore,
    background: Sequence[float],
    *,
    distances: PerceptualDistances | None = None,
) -> SplitMetrics:
    """Metrics of `scene` on `frames`: each view rendered at its own camera and time."""
    prepared = PreparedScene(scene)

    def pairs() -> Iterator[Pair]:
        for frame in frames:
            rendered = render(prepared, frame.camera, frame.time, background)
            color = rendered.color.clamp(0, 1).numpy()
            yield Pair(frame.name, frame.time, color, images.rgb(frame), images.valid(frame))

    return measure_split(pairs(), distances)


def subset(frames: Sequence[Frame], size: int) -> tuple[Frame, ...]:
    """At most `size` frames, chosen by the hash of their names: always the same, and spread over the capture."""
    if len(frames) <= size:
        return tuple(frames)
    order = sorted(range(len(frames)), key=lambda i: hashlib.sha256(frames[i].name.encode()).digest())
    return tuple(frames[i] for i in sorted(order[:size]))
