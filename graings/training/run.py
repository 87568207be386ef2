"""TrainingRun: one training in one folder, with its evaluations, checkpoints and metrics.

Iterating over it trains. The caller may stop at any step and call `save()`; `resume` continues bit for bit. A run
that diverges ends with `DivergedError` after its best model was made the newest checkpoint.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

from graings.capture.background import with_background
from graings.capture.capture import Capture
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import TrainConfig
from graings.errors import CheckpointError, DivergedError, GraingsError
from graings.kernel import computing_threads
from graings.plan.capture_statistics import measure
from graings.plan.plan import Plan, make_plan
from graings.report.events import Diverged, Event, RolledBack
from graings.report.metrics_document import EvaluationPoint
from graings.report.run_record import read_record
from graings.storage.checkpoint import intact, load_training, newest_checkpoint
from graings.storage.run_folder import METRICS_FILE, RECORD_FILE, check_unused, sole_trainer
from graings.training.calibration import kept_calibration
from graings.training.curriculum.missing_motion import MissingMotion, check_iteration
from graings.training.curriculum.restart import RestartState
from graings.training.density.unseen import drop_unseen
from graings.training.plan_revision import PlanRevision
from graings.training.run_output import RunOutput, RunReport, psnr_of_best
from graings.training.timing import Clock, Rate, evaluation_marks
from graings.training.tracks.feature_tracks import feature_tracks
from graings.training.tracks.motion_tracks import MotionTracks
from graings.training.trainer import Trainer
from graings.training.training_log import TrainingLog


class TrainingRun:
    """One run folder being trained. Make it with `create` or `resume`.

    It computes with `threads` CPU threads (None: those of `config`) while it makes its first scene and is iterated;
    the settings of the process are as before afterwards.
    """

    def __init__(
        self,
        folder: Path,
        capture: Capture,
        config: TrainConfig,
        threads: int | None,
        clock: Clock,
        plan: Plan | None = None,
    ) -> None:
        self.folder = folder
        self.capture = capture
        self.config = config
        self.threads = threads if threads is not None else config.threads
        seen = with_background(config.capture, capture)
        self.images = ImageStore(seen.background_rgb(), seen.cache_mb)
        if plan is None:
            statistics = measure(capture, self.images, seen.background_rgb())
            plan = make_plan(statistics, config, kept_calibration(self.threads))
        self.applied = plan.apply(config).model_copy(update={"capture": seen})
        self.log = TrainingLog(folder, capture, config, plan, clock)
        self.revision = PlanRevision(self.log)
        self.output = RunOutput(folder, self.images, self.log)

    @classmethod
    def create(cls, capture: Path, folder: Path, config: TrainConfig) -> TrainingRun:
        """Start a run of `config` on the capture at `capture`; `folder` must not hold a run.

        Raises `CaptureError` for the capture and `CheckpointError` for the folder.
        """
        check_unused(folder)
        clock = Clock()
        with clock.timed("load"):
            data = load_capture(capture, config.capture)
        with clock.timed("init"):
            run = cls(folder, data, config, None, clock)
        # Written first: what crosses a video is searched for up to a minute, and an interrupted search can be resumed.
        folder.mkdir(parents=True, exist_ok=True)
        with sole_trainer(folder):
            check_unused(folder)  # another may have begun here meanwhile
            run.log.write_run()
            run.revision.write()
        try:
            run._start()
        except GraingsError:
            (folder / RECORD_FILE).unlink()
            raise
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
        with clock.timed("load"):
            data = load_capture(capture or record.capture.path, config.capture)
        if data.content_hash != record.capture.hash:
            raise CheckpointError(f"{data.root}: not the capture this run began with. Give the original one.")
        with clock.timed("init"):
            run = cls(folder, data, config, threads, clock, record.plan)
        if newest_checkpoint(folder) is None:
            run._start()
            return run
        model, state = load_training(folder)
        with intact(model.path), computing_threads(run.threads):
            run._restart = RestartState(**state.facts["restart"])
            run._trainer = Trainer.resume(
                data,
                run.images,
                run._restart.config(run.applied),
                model.scene,
                state.tensors,
                state.facts["trainer"],
                run._restart.iterations_before,
            )
            run.log.load(state.facts, extended=model.config.iterations != config.iterations)
        run.output.best_psnr = psnr_of_best(folder, run._restart)
        return run

    def _start(self, restart: RestartState | None = None, tracks: MotionTracks | None = None) -> None:
        """A new scene, after a restart or, without one, of the whole run."""
        with self.log.clock.timed("init"), computing_threads(self.threads):
            if restart is None:
                tracks = feature_tracks(self.capture, self.images, self.applied)
                restart = RestartState.first(tracks is not None)
            config = restart.config(self.applied)
            self._trainer = Trainer.start(self.capture, self.images, config, restart.iterations_before, tracks)
        self._restart = restart
        self.output.best_psnr = None

    @property
    def iteration(self) -> int:
        """Iterations done, those before a restart included."""
        return self._restart.iterations_before + self._trainer.iteration

    @property
    def trainer(self) -> Trainer:
        """The optimisation in progress; another one after a restart."""
        return self._trainer

    @property
    def iterations(self) -> int:
        """Iterations planned; a restart adds those that were spent before it."""
        return self._restart.iterations_before + self.config.iterations

    @property
    def metrics_path(self) -> Path:
        """Where the metrics document is."""
        return self.folder / METRICS_FILE

    def __iter__(self) -> Iterator[RunReport]:
        with sole_trainer(self.folder), computing_threads(self.threads):
            try:
                yield from self._train()
            except DivergedError as error:
                self._deliver_best(str(error))
                raise

    def _train(self) -> Iterator[RunReport]:
        if self.iteration >= self.iterations:
            interrupted = not self.log.is_complete(self.iterations)
            if interrupted:
                # Between the last step and the last file: only the end remains to be done.
                self.log.forget_end(self.iteration)
                self._finish()
            yield self.output.last_report(self._trainer, self.iterations, events=interrupted)
            return
        with self.log.clock.timed("report"):
            self.revision.write()  # that of a killed process may be newer than its checkpoint
        rate = Rate()
        while self.iteration < self.iterations:
            step = self._trainer.step()
            self.log.clock.add(step.phase, step.seconds, step.cpu_s)
            self.log.gaussians = step.gaussians
            rate.add(step.seconds)
            self.revision.note(step)
            self._note(step.events)
            last = step.iteration == self.iterations
            saving = step.iteration % self.config.evaluation.checkpoint_every == 0
            evaluating = step.iteration in evaluation_marks(self.config, self.iterations)
            # A scene with a NaN is never evaluated or saved.
            events: tuple[Event, ...] = self._check() if last or saving or evaluating else ()
            point = self._evaluate() if evaluating and not last else None
            events += self.revision.revise(self._trainer, self.iteration) if evaluating and not last else ()
            events += self._restart_if_motion_is_missing()
            if saving and not last:
                self._save_unless_diverging()
            if last:
                point, more = self._finish()
                events += more
            now = {"gaussians": self.log.gaussians, "anchors": self._trainer.scene.scaffold.count}
            yield RunReport(
                **{part.name: getattr(step, part.name) for part in fields(step)}
                | {"events": step.events + events, **now},
                iterations_per_s=rate.per_second(),
                train_s=self.log.clock.train_s(),
                evaluation=point,
            )

    def save(self) -> Path:
        """Write a checkpoint now; returns the newest one. Raises `CheckpointError` when that fails.

        That is an earlier one while the loss is far above its best; a resumed run repeats the steps since then. A scene
        with a NaN is never written: training rolls back first, or raises `DivergedError`.
        """
        try:
            self._check()
        except DivergedError as error:
            self._deliver_best(str(error))
            raise
        return self._save_unless_diverging()

    def _save_unless_diverging(self) -> Path:
        """A resumed run has no snapshot but its checkpoint, and must not have to return to a diverging scene."""
        earlier = newest_checkpoint(self.folder)
        if earlier is not None and self._trainer.guard.diverging:
            return earlier
        return self._save()

    def _check(self) -> tuple[Event, ...]:
        events = tuple(self._trainer.check())
        self._note(events)
        return events

    def _note(self, events: tuple[Event, ...]) -> None:
        self.log.note(events)
        if any(isinstance(event, RolledBack) for event in events):
            self.revision.return_to(self._trainer)

    def _restart_if_motion_is_missing(self) -> tuple[Event, ...]:
        """Once, after part of the steps: restart with what helps to find a moving object that is missing.

        Training does not find an object later that it has missed by then. The restart takes as many iterations as
        the run was to have: with only the remaining ones a draft is 5 dB worse. A time window that was configured
        stays; one that was chosen from the masks gives way to tracks, but not to another window.
        """
        trainer, configured = self._trainer, self.applied.time_window
        due = self.iteration == check_iteration(self.applied) and self._restart == RestartState()
        if not due or configured is not None or not trainer.scene.temporal:
            return ()
        with self.log.clock.timed("init"):
            found = MissingMotion.find(trainer.scene, self.capture, self.images, self.applied)
        if found is None or (found.tracks is None and trainer.window.share(1) < 1):
            return ()
        self.revision.begin_again()
        self._start(RestartState(self.iteration, found.time_window, found.tracks is not None), found.tracks)
        self._trainer.guard.restarted(trainer.guard)
        self.log.note(events := (found.event(self.iteration),))
        return events

    def _save(self, **how: bool) -> Path:
        return self.output.save(self._trainer, self._restart, self.iteration, **how)

    def _evaluate(self) -> EvaluationPoint | None:
        point = self.output.evaluate(self._trainer, self.iteration)
        if point is not None:
            if self.output.is_best(point):
                self._save(best=True)
            self.output.write_metrics(self._trainer, self.iteration, self.iterations, {})
        return point

    def _finish(self) -> tuple[EvaluationPoint | None, tuple[Event, ...]]:
        """Evaluate all of val, write the last checkpoint, metrics and plots; returns the last point, and events."""
        trainer = self._trainer
        events = drop_unseen(trainer, self.log)
        point, splits = self.output.evaluate_end(trainer, self.iteration)
        events += (stiffness := self.output.stiffness(trainer)).events(self.iteration)
        self.log.note(events)
        self._save(finished=True)
        if point is not None and self.output.is_best(point):
            self._save(finished=True, best=True)
        compact = self.output.export(trainer)
        self.revision.finish(self.iteration, self.output.view_dependence(trainer))
        self.output.write_metrics(trainer, self.iteration, self.iterations, splits, compact, stiffness)
        return point, events

    def _deliver_best(self, reason: str) -> None:
        """Training has diverged: make the best model the newest checkpoint, and write the reason into the metrics.

        Later checkpoints are removed.
        """
        trainer = self._trainer
        self.log.note([Diverged(iteration=self.iteration, reason=reason)])
        self.log.diverged = reason
        self.output.return_to_best(trainer)
        self.revision.return_to(trainer)
        splits = self.output.splits(trainer)
        self._save(instead_of_later=True)
        compact, stiffness = self.output.export(trainer), self.output.stiffness(trainer)
        self.output.write_metrics(trainer, self.iteration, self.iterations, splits, compact, stiffness)
