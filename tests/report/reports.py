"""Hand-made metrics of runs, without training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from graings.report.work_precision import training_part


def point(train_s: float, psnr: float | None, *, iteration: int = 100, gaussians: int = 1000) -> dict[str, Any]:
    """One evaluation."""
    rmse = 10 ** (-(psnr or 0.0) / 20)
    return {
        **{"iteration": iteration, "train_s": train_s, "total_s": 1.1 * train_s, "psnr": psnr, "rmse": rmse},
        **{"ssim_3dgs": 0.9, "views": 8, "gaussians": gaussians, "anchors": gaussians // 10},
    }


def metrics(*curve: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """What a run writes, with a clock that adds up to 100 seconds."""
    phases = {"load": 1.0, "init": 2.0, "warmup": 18.0, "joint": 60.0, "evaluation": 12.0, "checkpoint": 7.0}
    document = {
        "schema": "graings.metrics/1",
        "splits": {"val": {"psnr": 30.0, "ssim_3dgs": 0.9, "views": [{"name": "a"}, {"name": "b"}]}},
        **{"train_s": 80.0, "total_s": 100.0, "wall_s": 101.0, "phases_s": phases, "iterations": 400},
        **{"gaussians": 4000, "anchors": 400, "bytes": {"fp32": 1, "compact": None}, "curve": list(curve)},
        "events": [{"iteration": 200, "what": "grew 3 anchors"}],
        "capture": {"frames": {"train": 8, "val": 2, "test": 2}, "times": 8, "width": 32, "height": 24, "notes": []},
        **{"machine": {"threads": 1}, "versions": {"graings": "0"}, "seed": 3, "hashes": {"config": "c"}},
    }
    return document | changes


def part(name: str, *curve: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """A part of kind training."""
    return training_part(name, metrics(*curve, **changes))


def write_run(folder: Path, document: dict[str, Any]) -> Path:
    """A run folder with nothing but its numbers."""
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(document))
    return folder
