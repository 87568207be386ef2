"""evaluate_run: a finished run on held-out views, written into its metrics document."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from graings.capture.capture import Split
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.errors import CheckpointError
from graings.evaluation.evaluate import evaluate
from graings.evaluation.metrics import Lpips, SplitMetrics
from graings.report.report import read_metrics, write_metrics
from graings.storage.compact import open_model
from graings.storage.run_folder import read_record


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
