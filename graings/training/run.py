"""TrainingRun: one training in one folder — trainer, evaluations, checkpoints and metrics.

Iterating it trains. Whoever iterates may stop at any step and call `save()`; `resume` continues bit for bit. A run
that diverges ends with `DivergedError` after its best model was made the newest checkpoint.
Knows nothing of terminals, jobs or HTTP.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from graings.capture.capture import SPLITS, Capture, Frame
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.checkpoint import (
    TrainingState,
    best_checkpoint,
    load_model,
    load_state,
    newest_checkpoint,
    save_checkpoint,
)
from graings.compact import read_compact, write_compact
from graings.config import TrainConfig, restored
from graings.errors import CheckpointError, DivergedError
from graings.evaluation import evaluate, frames_per_second, subset
from graings.machine import machine_facts, version_facts
from graings.metrics import Lpips, SplitMetrics
from graings.model import scene_bytes
from graings.plan import Plan, make_plan
from graings.report import METRICS_SCHEMA, config_hash, curve_svg, read_metrics, write_metrics, write_text
from graings.report_folder import report_training
from graings.run_folder import MODEL_FILE, sole_trainer
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
        self._best_psnr: float | None = None
        self._diverged: str | None = None

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
        stored = facts.get("config")
        if isinstance(stored, dict):  # a run that does not say how its matrices step began when all were Adam's
            stored = {"matrix_step": "adam"} | stored
        config = restored(TrainConfig, stored, folder / "run.json")
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
        best = best_checkpoint(folder)
        if best is not None:
            run._best_psnr = load_state(best).facts["curve"][-1]["psnr"]
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
            try:
                yield from self._train()
            except DivergedError as error:
                self._deliver(str(error))
                raise

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
            self._note(step.events)
            last = step.iteration == self.iterations
            saving = step.iteration % self.config.evaluation.checkpoint_every == 0
            # Nobody looks at a scene, or saves it, that is not finite.
            found = self._check() if last or saving or step.iteration in due else ()
            point = self._evaluate() if step.iteration in due and not last else None
            if saving and not last:
                self._save()
            if last:
                point = self._finish()
            yield RunReport(
                **({part.name: getattr(step, part.name) for part in fields(step)} | {"events": step.events + found}),
                iterations_per_s=rate.per_second(),
                train_s=self._clock.train_s(),
                evaluation=point,
            )

    def save(self) -> Path:
        """Write a checkpoint now; returns its folder. Raises `CheckpointError` when that fails.

        A scene that is not finite is never written: training goes back first, or raises `DivergedError`.
        """
        try:
            self._check()
        except DivergedError as error:
            self._deliver(str(error))
            raise
        return self._save()

    def _note(self, events: Iterable[str]) -> None:
        self._events += [{"iteration": self.iteration, "what": what} for what in events]

    def _check(self) -> tuple[str, ...]:
        found = tuple(self._trainer.check())
        self._note(found)
        return found

    def _save(self, *, finished: bool = False, best: bool = False, instead_of_later: bool = False) -> Path:
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
            best=best,
            instead_of_later=instead_of_later,
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
        if self._best_psnr is None or point.psnr > self._best_psnr:
            self._best_psnr = point.psnr
            self._save(best=True)
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
        point = None
        if self.capture.val:
            started = time.perf_counter()
            background = self.config.capture.background_rgb()
            point = self._point(evaluate(self._trainer.scene, self._held_out(), self.images, background))
            self._clock.add("evaluation", time.perf_counter() - started)
        splits = self._splits()
        self._save(finished=True)
        self._write_metrics(splits, self._export())
        return point

    def _export(self) -> dict[str, Any]:
        """Write the newest checkpoint as one small file: its name, its bytes, and the PSNR it has on all of val."""
        started = time.perf_counter()
        size = write_compact(load_model(self.folder), self.folder / MODEL_FILE)
        psnr = None
        if self.capture.val:
            scene, background = read_compact(self.folder / MODEL_FILE).scene, self.config.capture.background_rgb()
            psnr = evaluate(scene, self.capture.val, self.images, background).psnr
        self._clock.add("evaluation", time.perf_counter() - started)
        return {"file": MODEL_FILE, "bytes": size, "psnr": psnr}

    def _splits(self) -> dict[str, Any]:
        """Metrics of all of val, as a finished run reports them."""
        if not self.capture.val:
            return {}
        started = time.perf_counter()
        background = self.config.capture.background_rgb()
        full = evaluate(self._trainer.scene, self.capture.val, self.images, background, lpips=Lpips.find())
        self._clock.add("evaluation", time.perf_counter() - started)
        return {"val": full.to_json()}

    def _deliver(self, reason: str) -> None:
        """Training has diverged: make the best model the newest checkpoint, and say so in the metrics.

        The best is that of the last good moment or of the best evaluation, whichever held-out views like more. What
        was saved after it is dropped: nobody should find it in its place.
        """
        self._note([f"diverged: {reason}"])
        self._diverged = reason
        guard = self._trainer.guard
        self._trainer.restore()
        best, frames = best_checkpoint(self.folder), self._held_out()
        if best is not None and self._best_psnr is not None and frames:
            now = evaluate(self._trainer.scene, frames, self.images, self.config.capture.background_rgb())
            if now.psnr is None or self._best_psnr >= now.psnr:
                state = load_state(best)
                self._trainer.adopt(load_model(best).scene, state.tensors, state.facts["trainer"], guard)
                self._last_gaussians = int(state.facts["gaussians"])
        splits = self._splits()
        self._save(instead_of_later=True)
        self._write_metrics(splits, self._export())

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

    def _write_metrics(self, splits: dict[str, Any], compact: dict[str, Any] | None = None) -> None:
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
            "bytes": {"fp32": scene_bytes(scene), "compact": None if compact is None else compact["bytes"]},
            "compact": compact,
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
            "clipped_steps": self._trainer.guard.clipped,
            "rollbacks": self._trainer.guard.rollbacks,
            "diverged": self._diverged is not None,
            "diverged_reason": self._diverged,
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
