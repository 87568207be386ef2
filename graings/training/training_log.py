"""Journal: what a run says of itself — its curve, events and seconds, and the documents made of them.

Writes run.json, metrics.json, curve.svg and report/ in the run's folder. Knows nothing of how a scene is trained
or stored.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from graings.capture.capture import SPLITS, Capture
from graings.config import TrainConfig
from graings.evaluation.evaluate import frames_per_second, subset
from graings.evaluation.metrics import SplitMetrics
from graings.plan.plan import Plan
from graings.report.curve import curve_figure
from graings.report.figure_files import svg
from graings.report.folder import report_training
from graings.report.machine import machine_facts, version_facts
from graings.report.report import METRICS_SCHEMA, config_hash, write_metrics, write_text
from graings.report.work_precision import run_names
from graings.scene.scene import Scene
from graings.storage.model import scene_bytes
from graings.training.guard.guard import Guard
from graings.training.guard.stiffness import Stiffness
from graings.training.timing import Clock

SCHEMA = "graings.run/1"

# Frames per second are measured on this many views.
FPS_VIEWS = 8


@dataclass(frozen=True, slots=True)
class EvaluationPoint:
    """Held-out quality at one moment of training; `train_s` and `train_cpu_s` exclude evaluation and checkpoints."""

    iteration: int
    train_s: float
    train_cpu_s: float | None
    psnr: float
    rmse: float
    ssim_3dgs: float
    views: int
    gaussians: int
    anchors: int
    step_over_size: float | None
    subpixel_share: float | None


class TrainingLog:
    """The book of the run in `folder`. `gaussians` is how many the last step drew; `diverged` says why it gave up."""

    def __init__(self, folder: Path, capture: Capture, config: TrainConfig, plan: Plan, clock: Clock) -> None:
        self.folder = folder
        self.capture = capture
        self.config = config
        self.plan = plan
        self.clock = clock
        self.versions = version_facts()  # of the code that trains: a checkout may move on before the end
        self.curve: list[dict[str, Any]] = []
        self.events: list[dict[str, Any]] = []
        self.gaussians = 0
        self.diverged: str | None = None

    def note(self, iteration: int, events: Iterable[str]) -> None:
        """Keep what happened at `iteration`."""
        self.events += [{"iteration": iteration, "what": what} for what in events]

    def point(self, iteration: int, metrics: SplitMetrics, anchors: int, stiffness: Stiffness) -> EvaluationPoint:
        """Add what held-out views say at `iteration` to the curve. Raises `ValueError` without a view."""
        if metrics.psnr is None or metrics.ssim_3dgs is None:
            raise ValueError("a point of the curve needs at least one view")
        point = EvaluationPoint(
            iteration=iteration,
            train_s=self.clock.train_s(),
            train_cpu_s=self.clock.train_cpu_s,
            psnr=metrics.psnr,
            rmse=math.sqrt(sum(view.mse for view in metrics.views) / len(metrics.views)),
            ssim_3dgs=metrics.ssim_3dgs,
            views=len(metrics.views),
            gaussians=self.gaussians,
            anchors=anchors,
            step_over_size=stiffness.step_over_size,
            subpixel_share=stiffness.subpixel_share,
        )
        self.curve.append({**asdict(point), "total_s": self.clock.total_s()})
        return point

    def state(self) -> dict[str, Any]:
        """All of it as JSON, for a checkpoint."""
        return {
            "seconds": self.clock.seconds,
            "wall_s": self.clock.wall_s(),
            "train_cpu_s": self.clock.train_cpu_s,
            "curve": self.curve,
            "events": self.events,
            "gaussians": self.gaussians,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from what `state()` gave."""
        seconds = dict(state["seconds"])
        self.clock = Clock(seconds, state.get("wall_s", sum(seconds.values())), state.get("train_cpu_s"))
        self.curve = list(state["curve"])
        self.events = list(state["events"])
        self.gaussians = int(state["gaussians"])

    def write_run(self) -> None:
        """Write run.json: what is to be trained, on what and with which versions."""
        started = time.perf_counter()
        document = {
            "schema": SCHEMA,
            "capture": {
                "path": str(self.capture.root.resolve()),
                "hash": self.capture.content_hash,
                "kind": self.capture.kind,
                "notes": list(self.capture.notes),
            },
            "config": self.config.model_dump(mode="json"),
            "plan": self.plan.to_json(),
            "versions": self.versions,
        }
        write_metrics(self.folder / "run.json", document)
        self.clock.add("report", time.perf_counter() - started)

    def write_metrics(
        self,
        iteration: int,
        scene: Scene,
        background: Sequence[float],
        guard: Guard,
        threads: int,
        splits: dict[str, Any],
        compact: dict[str, Any] | None = None,
        stiffness: Stiffness | None = None,
    ) -> None:
        """Write metrics.json, curve.svg and report/ as of `iteration`.

        `splits` are the metrics of whole splits by name, `compact` the facts of the compact model and `stiffness` that
        of the end over all training views; they only exist once the run has ended.
        """
        started = time.perf_counter()
        fps = frames_per_second(scene, subset(self.capture.train, FPS_VIEWS), background)
        machine = machine_facts(threads)
        self.clock.add("report", time.perf_counter() - started)
        started = time.perf_counter()
        document = {
            "schema": METRICS_SCHEMA,
            "splits": splits,
            "train_s": self.clock.train_s(),
            "train_cpu_s": self.clock.train_cpu_s,
            "total_s": self.clock.total_s(),
            "wall_s": self.clock.wall_s(),
            "phases_s": dict(self.clock.seconds),
            "iterations": iteration,
            "gaussians": self.gaussians,
            "anchors": scene.scaffold.count,
            "bytes": {"fp32": scene_bytes(scene), "compact": None if compact is None else compact["bytes"]},
            "compact": compact,
            "render_fps": fps,
            "curve": self.curve,
            "events": self.events,
            "plan": self.plan.to_json(),
            "capture": {
                "frames": {split: len(self.capture.split(split)) for split in SPLITS},
                "times": len(self.capture.times),
                "width": self.capture.train[0].camera.width,
                "height": self.capture.train[0].camera.height,
                "background": list(background),
                "notes": list(self.capture.notes),
            },
            "skipped_steps": guard.skipped,
            "clipped_steps": guard.clipped,
            "rollbacks": guard.rollbacks,
            "stiffness": None if stiffness is None else asdict(stiffness) | {"stiff": stiffness.stiff},
            "diverged": self.diverged is not None,
            "diverged_reason": self.diverged,
            "machine": machine,
            "versions": self.versions,
            "seed": self.config.seed,
            "hashes": {"config": config_hash(self.config), "capture": self.capture.content_hash},
        }
        write_metrics(self.folder / "metrics.json", document)
        write_text(self.folder / "curve.svg", svg(curve_figure(self.curve)))
        name = run_names([self.folder])[0]
        facts = {"config": self.config.model_dump(mode="json")}
        report_training(name, document, facts, self.folder / "report")
        self.clock.add("report", time.perf_counter() - started)
