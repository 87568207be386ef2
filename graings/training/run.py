"""TrainingRun: one training in one folder — trainer, evaluations, checkpoints and metrics.

Iterating it trains. Whoever iterates may stop at any step and call `save()`; `resume` continues bit for bit.
Knows nothing of terminals, jobs or HTTP.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from graings.capture.capture import SPLITS, Capture, Frame
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.checkpoint import (
    TrainingState,
    load_model,
    load_state,
    newest_checkpoint,
    save_checkpoint,
    scene_bytes,
)
from graings.config import TrainConfig, restored
from graings.errors import CheckpointError
from graings.evaluation import evaluate, frames_per_second, subset
from graings.machine import machine_facts, version_facts
from graings.metrics import Lpips, SplitMetrics
from graings.plan import Plan, make_plan
from graings.report import METRICS_SCHEMA, config_hash, curve_svg, read_metrics, write_metrics, write_text
from graings.report_folder import report_training
from graings.run_folder import sole_trainer
from graings.threads import use_threads
from graings.training.pace import Clock, Rate, evaluation_marks
from graings.training.trainer import StepReport, Trainer
from graings.work_precision import run_names

SCHEMA = "graings.run/1"

# Frames per second are measured on this many views.
FPS_VIEWS = 8


@dataclass(frozen=True, slots=True)
class EvaluationPoint:
    """Held-out quality at one moment of training; `train_s` excludes evaluation and checkpoints."""

    iteration: int
    train_s: float
    psnr: float
    rmse: float
    ssim_3dgs: float
    views: int
    gaussians: int
    anchors: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RunReport(StepReport):
    """One step as a user wants to hear of it: with the pace of the run, and held-out quality where it was measured."""

    iterations_per_s: float
    train_s: float
    evaluation: EvaluationPoint | None = None


class TrainingRun:
    """One run folder being trained. Make it with `create` or `resume`."""

    def __init__(self, folder: Path, capture: Capture, config: TrainConfig, threads: int | None, clock: Clock) -> None:
        self.folder = folder
        self.capture = capture
        self.config = config
        self.threads = use_threads(threads if threads is not None else config.threads)
        self.plan: Plan = make_plan(capture, config)
        self.applied = self.plan.apply(config)
        self.images = ImageStore(config.capture.background_rgb(), config.capture.cache_mb)
        self._clock = clock
        started = time.perf_counter()
        self._trainer = Trainer(capture, self.images, self.applied)
        clock.add("init", time.perf_counter() - started)
        self._curve: list[dict[str, Any]] = []
        self._events: list[dict[str, Any]] = []
        self._last_gaussians = 0

    @classmethod
    def create(cls, capture: Path, folder: Path, config: TrainConfig) -> TrainingRun:
        """Start a run of `config` on the capture at `capture`; `folder` must be new or empty.

        Raises `CaptureError` for the capture and `CheckpointError` for the folder.
        """
        if (folder / "run.json").exists():
            raise CheckpointError(f"{folder}: already holds a run. Resume it (--resume) or choose another folder.")
        clock = Clock()
        started = time.perf_counter()
        data = load_capture(capture, config.capture)
        clock.add("load", time.perf_counter() - started)
        run = cls(folder, data, config, None, clock)
        folder.mkdir(parents=True, exist_ok=True)
        run._write_run()
        return run

    @classmethod
    def resume(cls, folder: Path, *, capture: Path | None = None, threads: int | None = None) -> TrainingRun:
        """Continue the run in `folder` from its newest checkpoint (from the start when there is none yet).

        `capture` is where the capture lies now, if it moved. Raises `CheckpointError` when the folder holds no
        run or the capture is another one.
        """
        try:
            facts = json.loads((folder / "run.json").read_text())
        except (OSError, ValueError) as error:
            raise CheckpointError(f"{folder}: holds no run to resume ({error}). Start one without --resume.") from error
        config = restored(TrainConfig, facts.get("config"), folder / "run.json")
        clock = Clock()
        started = time.perf_counter()
        data = load_capture(capture or Path(facts["capture"]["path"]), config.capture)
        if data.content_hash != facts["capture"]["hash"]:
            raise CheckpointError(f"{data.root}: not the capture this run began with. Give the original one.")
        clock.add("load", time.perf_counter() - started)
        run = cls(folder, data, config, threads, clock)
        if newest_checkpoint(folder) is not None:
            state = load_state(folder)
            run._trainer.load(load_model(folder).scene, state.tensors, state.facts["trainer"])
            seconds = dict(state.facts["seconds"])
            run._clock = Clock(seconds, state.facts.get("wall_s", sum(seconds.values())))
            run._curve = list(state.facts["curve"])
            run._events = list(state.facts["events"])
            run._last_gaussians = int(state.facts["gaussians"])
        return run

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return self._trainer.iteration

    @property
    def iterations(self) -> int:
        """Iterations wanted."""
        return self.config.iterations

    @property
    def metrics_path(self) -> Path:
        """Where the metrics document is."""
        return self.folder / "metrics.json"

    def __iter__(self) -> Iterator[RunReport]:
        with sole_trainer(self.folder):
            yield from self._train()

    def _train(self) -> Iterator[RunReport]:
        if self.iteration >= self.iterations and not self._is_complete():
            # Interrupted between the last step and the last file: only the end is left to do.
            self._finish()
        due = evaluation_marks(self.config)
        rate = Rate()
        for step in self._trainer:
            self._clock.add(step.phase, step.seconds)
            self._last_gaussians = step.gaussians
            rate.add(step.seconds)
            self._events += [{"iteration": step.iteration, "what": what} for what in step.events]
            last = step.iteration == self.iterations
            point = self._evaluate() if step.iteration in due and not last else None
            if step.iteration % self.config.evaluation.checkpoint_every == 0 and not last:
                self.save()
            if last:
                point = self._finish()
            yield RunReport(
                **{part.name: getattr(step, part.name) for part in fields(step)},
                iterations_per_s=rate.per_second(),
                train_s=self._clock.train_s(),
                evaluation=point,
            )

    def save(self, *, finished: bool = False) -> Path:
        """Write a checkpoint now; returns its folder. Raises `CheckpointError` when that fails."""
        started = time.perf_counter()
        tensors, facts = self._trainer.state()
        path = save_checkpoint(
            self.folder,
            scene=self._trainer.scene,
            state=TrainingState(
                tensors,
                {
                    "trainer": facts,
                    "seconds": self._clock.seconds,
                    "wall_s": self._clock.wall_s(),
                    "curve": self._curve,
                    "events": self._events,
                    "gaussians": self._last_gaussians,
                },
            ),
            units=self.capture.units,
            background=self.config.capture.background_rgb(),
            views={split: [frame.view() for frame in self.capture.split(split)] for split in SPLITS},
            config=self.config,
            iteration=self.iteration,
            finished=finished,
        )
        self._clock.add("checkpoint", time.perf_counter() - started)
        return path

    def _held_out(self) -> tuple[Frame, ...]:
        """Views for the curve: never the test split."""
        return subset(self.capture.val, self.config.evaluation.views)

    def _evaluate(self) -> EvaluationPoint | None:
        frames = self._held_out()
        if not frames:
            return None
        started = time.perf_counter()
        metrics = evaluate(self._trainer.scene, frames, self.images, self.config.capture.background_rgb())
        point = self._point(metrics)
        self._clock.add("evaluation", time.perf_counter() - started)
        self._write_metrics({})
        return point

    def _point(self, metrics: SplitMetrics) -> EvaluationPoint:
        if metrics.psnr is None or metrics.ssim_3dgs is None:
            raise ValueError("a point of the curve needs at least one view")
        rmse = math.sqrt(sum(view.mse for view in metrics.views) / len(metrics.views))
        point = EvaluationPoint(
            iteration=self.iteration,
            train_s=self._clock.train_s(),
            psnr=metrics.psnr,
            rmse=rmse,
            ssim_3dgs=metrics.ssim_3dgs,
            views=len(metrics.views),
            gaussians=self._last_gaussians,
            anchors=self._trainer.scene.scaffold.count,
        )
        self._curve.append({**asdict(point), "total_s": self._clock.total_s()})
        return point

    def _finish(self) -> EvaluationPoint | None:
        """Evaluate all of val, write the final checkpoint, metrics and curve."""
        point, splits = None, {}
        if self.capture.val:
            started = time.perf_counter()
            background = self.config.capture.background_rgb()
            scene = self._trainer.scene
            curve = self._held_out()
            point = self._point(evaluate(scene, curve, self.images, background))
            full = evaluate(scene, self.capture.val, self.images, background, lpips=Lpips.find())
            splits["val"] = full.to_json()
            self._clock.add("evaluation", time.perf_counter() - started)
        self.save(finished=True)
        self._write_metrics(splits)
        return point

    def _is_complete(self) -> bool:
        """Whether the metrics document is that of the last iteration."""
        if not self.metrics_path.exists():
            return False
        document = read_metrics(self.metrics_path)
        return bool(document["iterations"] == self.iterations and (document["splits"] or not self.capture.val))

    def _write_run(self) -> None:
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
            "versions": version_facts(),
        }
        write_metrics(self.folder / "run.json", document)
        self._clock.add("report", time.perf_counter() - started)

    def _write_metrics(self, splits: dict[str, Any]) -> None:
        started = time.perf_counter()
        scene, background = self._trainer.scene, self.config.capture.background_rgb()
        fps = frames_per_second(scene, subset(self.capture.train, FPS_VIEWS), background)
        machine, versions = machine_facts(self.threads), version_facts()
        self._clock.add("report", time.perf_counter() - started)
        started = time.perf_counter()
        document = {
            "schema": METRICS_SCHEMA,
            "splits": splits,
            "train_s": self._clock.train_s(),
            "total_s": self._clock.total_s(),
            "wall_s": self._clock.wall_s(),
            "phases_s": dict(self._clock.seconds),
            "iterations": self.iteration,
            "gaussians": self._last_gaussians,
            "anchors": scene.scaffold.count,
            "bytes": {"fp32": scene_bytes(scene), "compact": None},
            "render_fps": fps,
            "curve": self._curve,
            "events": self._events,
            "plan": self.plan.to_json(),
            "capture": {
                "frames": {split: len(self.capture.split(split)) for split in SPLITS},
                "times": len(self.capture.times),
                "width": self.capture.train[0].camera.width,
                "height": self.capture.train[0].camera.height,
                "background": list(background),
                "notes": list(self.capture.notes),
            },
            "skipped_steps": self._trainer.guard.skipped,
            "machine": machine,
            "versions": versions,
            "seed": self.config.seed,
            "hashes": {"config": config_hash(self.config), "capture": self.capture.content_hash},
        }
        write_metrics(self.metrics_path, document)
        write_text(self.folder / "curve.svg", curve_svg(self._curve))
        name = run_names([self.folder])[0]
        facts = {"config": self.config.model_dump(mode="json")}
        report_training(name, document, facts, self.folder / "report")
        self._clock.add("report", time.perf_counter() - started)
