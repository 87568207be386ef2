"""inspect_capture: everything about a capture that can be known before an hour is spent on it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.capture.background import with_background
from graings.capture.capture import ALL_SPLITS, Capture, Frame
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import CaptureConfig, TrainConfig, make_config
from graings.inspection.consistency import consistency
from graings.inspection.document import Forecast, Inspection, Vector
from graings.inspection.findings import findings, in_order
from graings.inspection.picture import draw_cameras
from graings.plan.capture_statistics import CaptureStatistics, measure
from graings.plan.cost import Calibration, expected_anchors
from graings.plan.plan import make_plan
from graings.scene.memory import bytes_per_anchor

PRESETS: Final = ("draft", "standard", "fine")

# Points outside this share, on either side and each axis, do not count for the bounds: matches go astray.
OUTLIERS: Final = 0.02

# Normalised distance of a camera from the centre that is none: it turns on the spot.
ROUNDING: Final = 1e-9

# Of a training process without images and anchors, MB.
BASE_MB: Final = 450.0
MEGABYTE: Final = 1e6


def inspect_capture(
    path: Path, config: CaptureConfig | None = None, calibration: Calibration | None = None, *, picture: bool = False
) -> tuple[Inspection, bytes | None]:
    """The document, and with `picture` a PNG of some cameras with the bounds of the scene.

    Raises `CaptureError` where the capture is refused.

    `calibration` holds the times of this machine; without it no minutes are predicted.
    """
    capture = load_capture(path, config)
    seen = with_background(config or CaptureConfig(), capture)
    background = seen.background_rgb()
    images = ImageStore(background, seen.cache_mb)
    statistics = measure(capture, images, background)
    tested = consistency(in_order(capture.train), images, capture.units, opengl=capture.kind == "transforms")
    low, high = bounds(capture)
    units, distances = capture.units, _distances(capture)
    first = capture.train[0]
    corners = units.points_back(np.stack([low, high]))
    document = Inspection(
        kind=capture.kind,
        content_hash=capture.content_hash,
        images={split: len(capture.split(split)) for split in ALL_SPLITS if capture.split(split)},
        source_size=first.source_size,
        time_range=None if units.time_span == 0 else (units.time_start, units.time_start + units.time_span),
        background=background,
        masked=sum(frame.mask_path is not None for split in ALL_SPLITS for frame in capture.split(split)),
        center=_vector(np.asarray(units.center)),
        bounds=(_vector(corners[0]), _vector(corners[1])),
        up=units.up,
        camera_distance=distances,
        statistics=statistics,
        consistency=tested,
        findings=findings(capture, statistics, tested, distances[1], _hidden(capture, images)),
        notes=capture.notes,
        forecasts={preset: _forecast(statistics, preset, seen, calibration) for preset in PRESETS},
    )
    return document, draw_cameras(capture, images, (low, high)) if picture else None


def bounds(capture: Capture) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners [3] of a box about the scene, normalised: around the points, or what the median camera sees."""
    if capture.points is not None:
        low, high = np.quantile(capture.points.positions, (OUTLIERS, 1 - OUTLIERS), axis=0)
        return low, high
    seen = [
        0.5 * float(np.linalg.norm(f.camera.center)) * min(f.camera.width / f.camera.fx, f.camera.height / f.camera.fy)
        for f in capture.train
    ]
    half = max(float(np.median(seen)), 1e-3)
    return np.full(3, -half), np.full(3, half)


def _distances(capture: Capture) -> tuple[float, float, float]:
    lengths = np.array([np.linalg.norm(frame.camera.center) for frame in capture.train]) / capture.units.scale
    lengths[lengths < ROUNDING / capture.units.scale] = 0.0
    least, median, greatest = np.quantile(lengths, (0.0, 0.5, 1.0)).tolist()
    return least, median, greatest


def _hidden(capture: Capture, images: ImageStore) -> float:
    """Mean share of masked pixels of the first training images with a mask."""
    some: list[Frame] = [frame for frame in capture.train if frame.mask_path is not None][:8]
    valid = [images.valid(frame) for frame in some]
    return float(np.mean([0.0 if each is None else 1.0 - each.mean() for each in valid])) if some else 0.0


def _forecast(
    statistics: CaptureStatistics, preset: str, capture: CaptureConfig, calibration: Calibration | None
) -> Forecast:
    config: TrainConfig = make_config(preset, {"capture": capture.model_dump()})
    plan = make_plan(statistics, config, calibration)
    cached = min(capture.cache_mb, statistics.images * statistics.pixels * 3 * 2 / MEGABYTE)
    anchors = max(
        expected_anchors(statistics), min(config.init.max_points, statistics.points or config.init.max_points)
    )
    if config.density.max_anchors is not None:
        anchors = min(anchors, config.density.max_anchors)
    grown = anchors * bytes_per_anchor(plan.apply(config).scene, min(config.batch, statistics.images)) / MEGABYTE
    minutes = None if plan.prediction is None else plan.prediction.minutes
    return Forecast(minutes=minutes, memory_mb=BASE_MB + cached + min(grown, float(config.density.memory_mb)))


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
