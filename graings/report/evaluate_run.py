"""evaluate_run: metrics of a finished run on held-out views, added to its metrics document."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from graings.capture.capture import Capture, Split
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.trajectories import Trajectories, read_trajectories
from graings.errors import CheckpointError, ConfigError
from graings.evaluation.evaluate import evaluate
from graings.evaluation.metrics import SplitMetrics
from graings.evaluation.motion import MotionMetrics, measure_motion
from graings.evaluation.perceptual import PerceptualDistances
from graings.report.metrics_document import read_metrics
from graings.report.run_record import read_record
from graings.storage.compact import open_model
from graings.storage.files import write_document
from graings.storage.model import Model
from graings.storage.run_folder import METRICS_FILE


def evaluate_run(
    run: Path, split: Split, capture: Path | None = None, background: Sequence[float] | None = None
) -> SplitMetrics:
    """Evaluate the newest model of a run on one split and write the result into its `metrics.json`.

    The capture is read from where it was during training unless `capture` names another place. With a `background` [3]
    other than that of training nothing is written: such metrics only tell whether opaque objects are opaque and empty
    space is empty. Of a capture with `trajectories.json` the error of tracked points is written too. Raises
    `CheckpointError` when the run has no model or the capture is not the one it was trained on, and `ConfigError` for a
    background of opaque images.
    """
    model = open_model(run)
    record = read_record(run)
    data = load_capture(capture or record.capture.path, model.config.capture)
    if data.content_hash != record.capture.hash:
        raise CheckpointError(
            f"{data.root}: not the capture this run was trained on. Give the original with --capture."
        )
    if background is not None and not data.has_alpha:
        raise ConfigError(
            f"{data.root}: has images without alpha, whose background cannot be exchanged. Leave out the background."
        )
    frames = data.split(split)
    # Before the views are rendered: what cannot be read is told in a second.
    read_metrics(run / METRICS_FILE)
    trajectories = read_trajectories(data.root)
    color = model.background if background is None else background
    images = ImageStore(color, model.config.capture.cache_mb)
    metrics = evaluate(model.scene, frames, images, color, distances=PerceptualDistances.find())
    if background is not None:
        return metrics
    document = read_metrics(run / METRICS_FILE)  # again: another evaluation may have added its split meanwhile
    update = {"splits": {**document.splits, split: metrics}, "motion": _motion(model, data, trajectories)}
    write_document(run / METRICS_FILE, document.model_copy(update=update))
    return metrics


def _motion(model: Model, capture: Capture, trajectories: Trajectories | None) -> MotionMetrics | None:
    """The error of tracked points; None where the capture has no trajectories."""
    if trajectories is None:
        return None
    times = [capture.units.time(time) for time in trajectories.times]
    eye = capture.train[0].camera.center
    return measure_motion(model.scene, eye, times, capture.units.points(trajectories.array()))
