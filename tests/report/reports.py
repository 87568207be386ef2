"""Hand-made metrics of runs, without training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from graings.plan.decision import Decision
from graings.plan.plan import Plan
from graings.report.machine import machine_facts, version_facts
from graings.report.metrics_document import EvaluationPoint, Metrics
from graings.report.work_precision import training_part
from graings.report.work_precision_document import TrainingPart
from graings.storage.files import write_document

VIEW = {"time": 0.5, "psnr": 30.0, "ssim_3dgs": 0.9, "lpips_vgg": None, "flip_ldr": None, "compared": 1.0, "mse": 1e-3}


def point(train_s: float, psnr: float, *, iteration: int = 100, gaussians: int = 1000) -> EvaluationPoint:
    """One evaluation."""
    return EvaluationPoint(
        iteration=iteration,
        train_s=train_s,
        train_cpu_s=2 * train_s,
        total_s=1.1 * train_s,
        psnr=psnr,
        rmse=10 ** (-psnr / 20),
        ssim_3dgs=0.9,
        views=8,
        gaussians=gaussians,
        anchors=gaussians // 10,
        step_over_size=0.5,
        subpixel_share=None,
    )


def values(*curve: EvaluationPoint, **changes: Any) -> dict[str, Any]:
    """What a run writes, with phases that add up to 100 seconds."""
    document = {
        "schema": "graings.metrics/1",
        "splits": {
            "val": {
                "psnr": 30.0,
                "ssim_3dgs": 0.9,
                "lpips_vgg": None,
                "lpips_reason": "not installed",
                "flip_ldr": None,
                "flip_reason": "not installed",
                "saturated": False,
                "reason": None,
                "views": [{"name": "a", **VIEW}, {"name": "b", **VIEW}],
            }
        },
        "motion": None,
        "train_s": 80.0,
        "train_cpu_s": 150.0,
        "total_s": 100.0,
        "wall_s": 101.0,
        "phases_s": {"load": 1.0, "init": 2.0, "warmup": 18.0, "joint": 60.0, "evaluation": 12.0, "checkpoint": 7.0},
        "iterations": 400,
        "iterations_planned": 400,
        "gaussians": 4000,
        "anchors": 400,
        "bytes": {"fp32": 1, "compact": None},
        "compact": None,
        "render_fps": 20.0,
        "curve": [evaluation.to_json() for evaluation in curve],
        "events": [{"iteration": 200, "kind": "grew", "anchors": 3, "message": "grew 3 anchors"}],
        "plan": Plan(
            decisions=(Decision(component="rigidity", decision="drop", kind="user", reason="weight 0"),)
        ).to_json(),
        "capture": {
            "frames": {"train": 8, "val": 2, "test": 2},
            "times": 8,
            "width": 32,
            "height": 24,
            "background": [1.0, 1.0, 1.0],
            "notes": [],
        },
        "skipped_steps": 0,
        "clipped_steps": 1,
        "rollbacks": 0,
        "stiffness": {"step_over_size": 0.5, "subpixel_share": 0.1, "views": 8, "stiff": False},
        "diverged": False,
        "diverged_reason": None,
        "machine": machine_facts(1).to_json(),
        "versions": version_facts().to_json(),
        "seed": 3,
        "hashes": {"config": "c", "capture": "d"},
    }
    return document | changes


def metrics(*curve: EvaluationPoint, **changes: Any) -> Metrics:
    """The same as a document."""
    return Metrics.model_validate(values(*curve, **changes))


def part(name: str, *curve: EvaluationPoint, **changes: Any) -> TrainingPart:
    """A part of kind training."""
    return training_part(name, metrics(*curve, **changes))


def write_run(folder: Path, document: Metrics | dict[str, Any]) -> Path:
    """A run folder with nothing but its numbers."""
    folder.mkdir(parents=True)
    if isinstance(document, Metrics):
        write_document(folder / "metrics.json", document)
    else:
        (folder / "metrics.json").write_text(json.dumps(document))
    return folder
