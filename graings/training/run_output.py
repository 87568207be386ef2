"""RunOutput: what a run writes into its folder while it trains and when it ends."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from graings.capture.capture import ALL_SPLITS, Frame, Split
from graings.capture.images import ImageStore
from graings.errors import CheckpointError
from graings.evaluation.evaluate import evaluate, subset
from graings.evaluation.metrics import SplitMetrics
from graings.evaluation.perceptual import PerceptualDistances
from graings.kernel import thread_count
from graings.report.metrics_document import CompactFacts, EvaluationPoint
from graings.storage.checkpoint import TrainingState, best_checkpoint, load_model, load_state, save_checkpoint
from graings.storage.compact import read_compact, write_compact
from graings.storage.run_folder import MODEL_FILE
from graings.training.curriculum.restart import RestartState
from graings.training.guard.stiffness import Stiffness, subpixel_share
from graings.training.held_out import HeldOut
from graings.training.step_report import StepReport
from graings.training.trainer import Trainer
from graings.training.training_log import TrainingLog
from graings.training.view_dependence import view_dependence

LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunReport(StepReport):
    """One step with the speed of the run, and held-out quality where it was evaluated."""

    iterations_per_s: float
    train_s: float
    evaluation: EvaluationPoint | None = None


@dataclass(slots=True, eq=False)
class RunOutput:
    """Evaluates, saves and reports the run in `folder`; every second is booked in the log's clock."""

    folder: Path
    images: ImageStore
    log: TrainingLog
    render_fps: float | None = None  # of the newest evaluation; None before the first
    best_psnr: float | None = None  # of the best evaluation since the last restart, in dB

    def held_out(self) -> tuple[Frame, ...]:
        """Validation views of the curve; never test views."""
        return subset(self.log.capture.val, self.log.config.evaluation.views)

    def evaluate(self, trainer: Trainer, iteration: int) -> EvaluationPoint | None:
        """Measure the held-out views and add a point to the curve; None where there are none to compare."""
        frames = self.held_out()
        if not frames:
            return None
        with self.log.clock.timed("evaluation"):
            held_out = self._measure(trainer, frames)
            return self._point(trainer, iteration, held_out.metrics, held_out.subpixel_share)

    def evaluate_end(
        self, trainer: Trainer, iteration: int
    ) -> tuple[EvaluationPoint | None, dict[Split, SplitMetrics]]:
        """Measure all validation views once: the last point of the curve, and the metrics of the split."""
        frames = self.log.capture.val
        with self.log.clock.timed("evaluation"):
            if not frames:
                some = subset(self.log.capture.train, self.log.config.evaluation.views)
                self.render_fps = HeldOut.measure(
                    trainer.scene, some, self.images, trainer.background
                ).frames_per_second
                return None, {}
            held_out = HeldOut.measure(
                trainer.scene, frames, self.images, trainer.background, PerceptualDistances.find()
            )
            self.render_fps = held_out.frames_per_second
            chosen = {frame.name for frame in self.held_out()}
            of_curve = SplitMetrics.over([view for view in held_out.metrics.views if view.name in chosen])
            point = self._point(trainer, iteration, of_curve, held_out.subpixel_share)
            return point, {"val": held_out.metrics}

    def splits(self, trainer: Trainer) -> dict[Split, SplitMetrics]:
        """Metrics of all validation views of the scene as it is, without a point of the curve."""
        if not self.log.capture.val:
            return {}
        frames = self.log.capture.val
        with self.log.clock.timed("evaluation"):
            held_out = HeldOut.measure(
                trainer.scene, frames, self.images, trainer.background, PerceptualDistances.find()
            )
            self.render_fps = held_out.frames_per_second
            return {"val": held_out.metrics}

    def _measure(
        self, trainer: Trainer, frames: Sequence[Frame], perceptual: PerceptualDistances | None = None
    ) -> HeldOut:
        held_out = HeldOut.measure(trainer.scene, frames, self.images, trainer.background, perceptual)
        self.render_fps = held_out.frames_per_second
        return held_out

    def _point(
        self, trainer: Trainer, iteration: int, metrics: SplitMetrics, share: float | None
    ) -> EvaluationPoint | None:
        stiffness = Stiffness(trainer.step_over_size, share, len(metrics.views))
        return self.log.point(iteration, metrics, trainer.scene.scaffold.count, stiffness)

    def stiffness(self, trainer: Trainer) -> Stiffness:
        """Of the end, over all training views."""
        frames = self.log.capture.train
        with self.log.clock.timed("evaluation"):
            share = subpixel_share(trainer.scene, frames, trainer.background)
            return Stiffness(trainer.step_over_size, share, len(frames))

    def view_dependence(self, trainer: Trainer) -> float | None:
        """Loss of PSNR of the held-out views with the colours of other views, in dB; None without any."""
        others = self.log.capture.train
        with self.log.clock.timed("evaluation"):
            return view_dependence(trainer.scene, self.held_out(), others, self.images, trainer.background)

    def psnr(self, trainer: Trainer, frames: Sequence[Frame]) -> float | None:
        """Mean PSNR of the scene as it is over `frames`, in dB."""
        return evaluate(trainer.scene, frames, self.images, trainer.background).psnr

    def is_best(self, point: EvaluationPoint) -> bool:
        """Whether no evaluation since the last restart had a higher PSNR; from now on this point is among them."""
        if self.best_psnr is not None and point.psnr <= self.best_psnr:
            return False
        self.best_psnr = point.psnr
        return True

    def return_to_best(self, trainer: Trainer) -> None:
        """Return to the last snapshot or to the best evaluation, whichever has the higher held-out PSNR."""
        guard = trainer.guard
        trainer.restore()
        best, frames = best_checkpoint(self.folder), self.held_out()
        if best is not None and self.best_psnr is not None and frames:
            now = self.psnr(trainer, frames)
            if now is None or self.best_psnr >= now:
                state = load_state(best)
                trainer.adopt(load_model(best).scene, state.tensors, state.facts["trainer"], guard)
                self.log.gaussians = int(state.facts["gaussians"])
        self.log.forget_after(trainer.run_iteration)

    def save(
        self,
        trainer: Trainer,
        restart: RestartState,
        iteration: int,
        *,
        finished: bool = False,
        best: bool = False,
        instead_of_later: bool = False,
    ) -> Path:
        """Write a checkpoint; see `save_checkpoint`."""
        with self.log.clock.timed("checkpoint"):
            tensors, facts = trainer.state()
            capture = self.log.capture
            return save_checkpoint(
                self.folder,
                scene=trainer.scene,
                state=TrainingState(tensors, {"trainer": facts, "restart": asdict(restart), **self.log.state()}),
                units=capture.units,
                background=trainer.background,
                views={split: [frame.view() for frame in capture.split(split)] for split in ALL_SPLITS},
                config=self.log.config,
                iteration=iteration,
                finished=finished,
                best=best,
                instead_of_later=instead_of_later,
            )

    def export(self, trainer: Trainer) -> CompactFacts:
        """Write the newest checkpoint as a compact file: its name, its bytes, and its PSNR over all of val."""
        with self.log.clock.timed("evaluation"):
            size = write_compact(load_model(self.folder), self.folder / MODEL_FILE)
            psnr = None
            if self.log.capture.val:
                scene = read_compact(self.folder / MODEL_FILE).scene
                psnr = evaluate(scene, self.log.capture.val, self.images, trainer.background).psnr
            return CompactFacts(file=MODEL_FILE, bytes=size, psnr=psnr)

    def write_metrics(
        self,
        trainer: Trainer,
        iteration: int,
        planned: int,
        splits: dict[Split, SplitMetrics],
        compact: CompactFacts | None = None,
        stiffness: Stiffness | None = None,
    ) -> None:
        """Write metrics.json, the curve and the report as of `iteration` of the `planned` ones."""
        self.log.write_metrics(
            iteration,
            planned,
            trainer.scene,
            trainer.background,
            trainer.guard,
            thread_count(),
            splits,
            self.render_fps,
            compact,
            stiffness,
        )

    def last_report(self, trainer: Trainer, iterations: int, *, events: bool) -> RunReport:
        """The report of the last of all `iterations`, where an earlier process took that step; its loss is not known.

        With or without the `events` of that iteration.
        """
        iteration, points = trainer.run_iteration, self.log.curve[-1:]
        return RunReport(
            iteration=iteration,
            iterations=iterations,
            phase=trainer.phase(trainer.iteration).name,
            loss=math.nan,
            psnr=math.nan,
            gaussians=self.log.gaussians,
            anchors=trainer.scene.scaffold.count,
            seconds=0.0,
            cpu_s=0.0,
            events=tuple(event for event in self.log.events if event.iteration == iteration) if events else (),
            iterations_per_s=0.0,
            train_s=self.log.clock.train_s(),
            evaluation=points[0] if points and points[0].iteration == iteration else None,
        )


def psnr_of_best(folder: Path, restart: RestartState) -> float | None:
    """Held-out PSNR of the best checkpoint since the `restart`; None where there is none that can be read."""
    best = best_checkpoint(folder)
    if best is None:
        return None
    try:
        facts: dict[str, Any] = load_state(best).facts
        return float(facts["curve"][-1]["psnr"]) if RestartState(**facts["restart"]) == restart else None
    except (CheckpointError, KeyError, IndexError, TypeError, ValueError) as error:
        LOG.warning("%s: cannot be read (%s). The next evaluation replaces it.", best, error)
        return None
