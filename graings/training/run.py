"""TrainingRun: one training in one folder — trainer, evaluations, checkpoints and metrics.

Iterating it trains. Whoever iterates may stop at any step and call `save()`; `resume` continues bit for bit. A run
that diverges ends with `DivergedError` after its best model was made the newest checkpoint.
Knows nothing of terminals, jobs or HTTP.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from graings.capture.background import with_background
from graings.capture.capture import SPLITS, Capture, Frame, Split
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import TrainConfig
from graings.errors import CheckpointError, DivergedError
from graings.evaluation.evaluate import evaluate, subset
from graings.evaluation.metrics import Lpips, SplitMetrics
from graings.kernel import use_threads
from graings.plan.plan import Plan, make_plan
from graings.report.events import Diverged, Event, Restarted
from graings.report.metrics_document import CompactFacts, EvaluationPoint, read_metrics
from graings.report.run_record import read_record
from graings.storage.checkpoint import (
    TrainingState,
    best_checkpoint,
    load_model,
    load_state,
    load_training,
    newest_checkpoint,
    save_checkpoint,
)
from graings.storage.compact import read_compact, write_compact
from graings.storage.run_folder import MODEL_FILE, sole_trainer
from graings.training.curriculum import missing_motion
from graings.training.curriculum.restart import RestartState
from graings.training.guard.stiffness import Stiffness, subpixel_share
from graings.training.timing import Clock, Rate, evaluation_marks
from graings.training.trainer import StepReport, Trainer
from graings.training.training_log import TrainingLog

LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunReport(StepReport):
    """One step as a user wants to hear of it: with the pace of the run, and held-out quality where it was measured."""

    iterations_per_s: float
    train_s: float
    evaluation: EvaluationPoint | None = None


class TrainingRun:
    """One run folder being trained. Make it with `create` or `resume`."""

    def __init__(
        self,
        folder: Path,
        capture: Capture,
        config: TrainConfig,
        threads: int | None,
        clock: Clock,
        attempt: RestartState | None = None,
    ) -> None:
        self.folder = folder
        self.capture = capture
        self.config = config
        self.threads = use_threads(threads if threads is not None else config.threads)
        self.plan: Plan = make_plan(capture, config)
        started, computed = time.perf_counter(), time.process_time()
        seen = with_background(config.capture, capture)
        self.applied = self.plan.apply(config).model_copy(update={"capture": seen})
        self.images = ImageStore(seen.background_rgb(), seen.cache_mb)
        self._journal = TrainingLog(folder, capture, config, self.plan, clock)
        self._begin(attempt or RestartState())
        clock.add("init", time.perf_counter() - started, time.process_time() - computed)

    def _begin(self, attempt: RestartState) -> None:
        self._attempt = attempt
        self._trainer = Trainer(self.capture, self.images, attempt.config(self.applied), attempt.iterations_before)
        self._best_psnr: float | None = None

    @classmethod
    def create(cls, capture: Path, folder: Path, config: TrainConfig) -> TrainingRun:
        """Start a run of `config` on the capture at `capture`; `folder` must not hold a run.

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
        run._journal.write_run()
        return run

    @classmethod
    def resume(cls, folder: Path, *, capture: Path | None = None, threads: int | None = None) -> TrainingRun:
        """Continue the run in `folder` from its newest checkpoint (from the start when there is none yet).

        `capture` is where the capture lies now, if it moved. Raises `CheckpointError` when the folder holds no
        run or the capture is another one.
        """
        record = read_record(folder)
        config = record.config
        clock = Clock()
        started = time.perf_counter()
        data = load_capture(capture or record.capture.path, config.capture)
        if data.content_hash != record.capture.hash:
            raise CheckpointError(f"{data.root}: not the capture this run began with. Give the original one.")
        clock.add("load", time.perf_counter() - started)
        if newest_checkpoint(folder) is None:
            return cls(folder, data, config, threads, clock)
        model, state = load_training(folder)
        with _intact(model.path):
            attempt = RestartState.of(state.facts)
        run = cls(folder, data, config, threads, clock, attempt)
        with _intact(model.path):
            run._trainer.load(model.scene, state.tensors, state.facts["trainer"])
            run._journal.load(state.facts)
        run._best_psnr = _psnr_of_best(folder, attempt)
        return run

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return self._attempt.iterations_before + self._trainer.iteration

    @property
    def iterations(self) -> int:
        """Iterations wanted."""
        return self._attempt.iterations_before + self.config.iterations

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
        rate = Rate()
        while self.iteration < self.iterations:
            step = self._trainer.step()
            self._journal.clock.add(step.phase, step.seconds, step.cpu_s)
            self._journal.gaussians = step.gaussians
            rate.add(step.seconds)
            self._journal.note(step.events)
            last = step.iteration == self.iterations
            saving = step.iteration % self.config.evaluation.checkpoint_every == 0
            # Nobody looks at a scene, or saves it, that is not finite.
            due = step.iteration in evaluation_marks(self.config, self.iterations)
            found = self._check() if last or saving or due else ()
            point = self._evaluate() if due and not last else None
            found += self._look_for_lost()
            if saving and not last:
                self._save()
            if last:
                point, final_events = self._finish()
                found += final_events
            yield RunReport(
                **({part.name: getattr(step, part.name) for part in fields(step)} | {"events": step.events + found}),
                iterations_per_s=rate.per_second(),
                train_s=self._journal.clock.train_s(),
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

    def _check(self) -> tuple[Event, ...]:
        found = tuple(self._trainer.check())
        self._journal.note(found)
        return found

    def _look_for_lost(self) -> tuple[Event, ...]:
        """Once, early enough: begin again in a part of the clip where training has lost what moves in all of it.

        What is lost once is not found again. The new attempt takes as many iterations as the run was to have: what
        fewer leave of a draft is worth 5 dB. A window that was asked for, or that the masks asked for, stays.
        """
        trainer = self._trainer
        chosen = self.applied.time_window is not None or trainer.window.share(1) < 1
        if self.iteration != missing_motion.look_at(self.applied) or self._attempt.iterations_before > 0 or chosen:
            return ()
        part = missing_motion.restart_window(self.applied, [frame.time for frame in self.capture.train])
        if part is None or not trainer.scene.temporal:
            return ()
        started, computed = time.perf_counter(), time.process_time()
        frames = subset(self.capture.train, missing_motion.VIEWS)
        share = missing_motion.missing_fraction(trainer.scene, frames, self.images, trainer.background)
        events: tuple[Event, ...] = ()
        if share > missing_motion.MAX_MISSING_FRACTION:
            self._begin(RestartState(self.iteration, part))
            events = (Restarted(iteration=self.iteration, missing_share=share, time_window=part),)
            self._journal.note(events)
        self._journal.clock.add("init", time.perf_counter() - started, time.process_time() - computed)
        return events

    def _save(self, *, finished: bool = False, best: bool = False, instead_of_later: bool = False) -> Path:
        started = time.perf_counter()
        tensors, facts = self._trainer.state()
        path = save_checkpoint(
            self.folder,
            scene=self._trainer.scene,
            state=TrainingState(
                tensors,
                {"trainer": facts, "attempt": asdict(self._attempt), **self._journal.state()},
            ),
            units=self.capture.units,
            background=self._trainer.background,
            views={split: [frame.view() for frame in self.capture.split(split)] for split in SPLITS},
            config=self.config,
            iteration=self.iteration,
            finished=finished,
            best=best,
            instead_of_later=instead_of_later,
        )
        self._journal.clock.add("checkpoint", time.perf_counter() - started)
        return path

    def _held_out(self) -> tuple[Frame, ...]:
        """Views for the curve: never the test split."""
        return subset(self.capture.val, self.config.evaluation.views)

    def _evaluate(self) -> EvaluationPoint | None:
        frames = self._held_out()
        if not frames:
            return None
        started = time.perf_counter()
        metrics = evaluate(self._trainer.scene, frames, self.images, self._trainer.background)
        point = self._point(metrics)
        self._journal.clock.add("evaluation", time.perf_counter() - started)
        if self._best_psnr is None or point.psnr > self._best_psnr:
            self._best_psnr = point.psnr
            self._save(best=True)
        self._write_metrics({})
        return point

    def _finish(self) -> tuple[EvaluationPoint | None, tuple[Event, ...]]:
        """Evaluate all of val, write the final checkpoint, metrics and curve; returns the last point, and events."""
        point = None
        started = time.perf_counter()
        if self.capture.val:
            point = self._point(evaluate(self._trainer.scene, self._held_out(), self.images, self._trainer.background))
        stiffness = self._stiffness(self.capture.train)
        self._journal.clock.add("evaluation", time.perf_counter() - started)
        events = stiffness.events(self.iteration)
        self._journal.note(events)
        splits = self._splits()
        self._save(finished=True)
        self._write_metrics(splits, self._export(), stiffness)
        return point, events

    def _stiffness(self, frames: Sequence[Frame]) -> Stiffness:
        trainer = self._trainer
        return Stiffness(trainer.step_over_size, subpixel_share(trainer.scene, frames, trainer.background), len(frames))

    def _export(self) -> CompactFacts:
        """Write the newest checkpoint as one small file: its name, its bytes, and the PSNR it has on all of val."""
        started = time.perf_counter()
        size = write_compact(load_model(self.folder), self.folder / MODEL_FILE)
        psnr = None
        if self.capture.val:
            scene, background = read_compact(self.folder / MODEL_FILE).scene, self._trainer.background
            psnr = evaluate(scene, self.capture.val, self.images, background).psnr
        self._journal.clock.add("evaluation", time.perf_counter() - started)
        return CompactFacts(file=MODEL_FILE, bytes=size, psnr=psnr)

    def _splits(self) -> dict[Split, SplitMetrics]:
        """Metrics of all of val, as a finished run reports them."""
        if not self.capture.val:
            return {}
        started = time.perf_counter()
        trainer = self._trainer
        full = evaluate(trainer.scene, self.capture.val, self.images, trainer.background, lpips=Lpips.find())
        self._journal.clock.add("evaluation", time.perf_counter() - started)
        return {"val": full}

    def _deliver(self, reason: str) -> None:
        """Training has diverged: make the best model the newest checkpoint, and say so in the metrics.

        The best is that of the last good moment or of the best evaluation, whichever held-out views like more. What
        was saved after it is dropped: nobody should find it in its place.
        """
        self._journal.note([Diverged(iteration=self.iteration, reason=reason)])
        self._journal.diverged = reason
        guard = self._trainer.guard
        self._trainer.restore()
        best, frames = best_checkpoint(self.folder), self._held_out()
        if best is not None and self._best_psnr is not None and frames:
            now = evaluate(self._trainer.scene, frames, self.images, self._trainer.background)
            if now.psnr is None or self._best_psnr >= now.psnr:
                state = load_state(best)
                self._trainer.adopt(load_model(best).scene, state.tensors, state.facts["trainer"], guard)
                self._journal.gaussians = int(state.facts["gaussians"])
        splits = self._splits()
        self._save(instead_of_later=True)
        self._write_metrics(splits, self._export(), self._stiffness(self.capture.train))

    def _is_complete(self) -> bool:
        """Whether the metrics document is that of the last iteration."""
        if not self.metrics_path.exists():
            return False
        document = read_metrics(self.metrics_path)
        return document.iterations == self.iterations and bool(document.splits or not self.capture.val)

    def _write_metrics(
        self, splits: dict[Split, SplitMetrics], compact: CompactFacts | None = None, stiffness: Stiffness | None = None
    ) -> None:
        trainer = self._trainer
        facts = (self.threads, splits, compact, stiffness)
        self._journal.write_metrics(self.iteration, trainer.scene, trainer.background, trainer.guard, *facts)

    def _point(self, metrics: SplitMetrics) -> EvaluationPoint:
        stiffness = self._stiffness(subset(self.capture.train, self.config.evaluation.views))
        return self._journal.point(self.iteration, metrics, self._trainer.scene.scaffold.count, stiffness)


@contextmanager
def _intact(checkpoint: Path) -> Iterator[None]:
    """Raise `CheckpointError` about `checkpoint` where what it holds does not fit."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, RuntimeError) as error:
        raise CheckpointError(
            f"{checkpoint}: damaged training state ({error!r}). Remove it to go on from an earlier one."
        ) from error


def _psnr_of_best(folder: Path, attempt: RestartState) -> float | None:
    """Held-out PSNR of the best checkpoint of `attempt` so far; None where none can be read."""
    best = best_checkpoint(folder)
    if best is None:
        return None
    try:
        facts = load_state(best).facts
        return float(facts["curve"][-1]["psnr"]) if RestartState.of(facts) == attempt else None
    except (CheckpointError, KeyError, IndexError, TypeError, ValueError) as error:
        LOG.warning("%s: cannot be read (%s). The next evaluation takes its place.", best, error)
        return None
