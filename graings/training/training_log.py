"""TrainingLog: curve, events and seconds of a run, and the documents made of them.

Writes run.json, metrics.json, curve.svg and report/ in the run's folder.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from graings.capture.capture import SPLITS, Capture, Split
from graings.config import TrainConfig
from graings.document import Document
from graings.evaluation.metrics import SplitMetrics
from graings.plan.plan import Plan
from graings.report.curve import curve_figure
from graings.report.events import Event, RolledBack, Stiff
from graings.report.figure_files import svg
from graings.report.folder import report_training
from graings.report.machine import machine_facts, version_facts
from graings.report.metrics_document import (
    CaptureFacts,
    CompactFacts,
    EvaluationPoint,
    Hashes,
    Metrics,
    ModelBytes,
    StiffnessFacts,
    config_hash,
    read_metrics,
)
from graings.report.run_record import CaptureSource, RunRecord
from graings.report.work_precision import run_names
from graings.scene.scene import Scene
from graings.storage.files import write_document, write_text
from graings.storage.model import scene_bytes
from graings.storage.run_folder import CURVE_FILE, METRICS_FILE, RECORD_FILE
from graings.training.guard.guard import Guard
from graings.training.guard.stiffness import Stiffness
from graings.training.timing import Clock

# While a run trains, its plots are drawn again only after they took less than this share of the training time.
MAX_PLOTTING_SHARE: Final = 0.02


class LogState(Document):
    """What a checkpoint keeps of the log."""

    seconds: dict[str, float]
    wall_s: float
    train_cpu_s: float
    curve: tuple[EvaluationPoint, ...]
    events: tuple[Event, ...]
    gaussians: int
    plan: Plan
    residual_unseen: int


class TrainingLog:
    """The log of the run in `folder`.

    `gaussians` is how many the last step drew; `diverged` is why training gave up, None while it has not. `plan` is
    what training has made of the plan, and `residual_unseen` how many evaluations in a row found that the residual
    does not show (`graings.training.plan_revision`).
    """

    def __init__(self, folder: Path, capture: Capture, config: TrainConfig, plan: Plan, clock: Clock) -> None:
        self.folder = folder
        self.capture = capture
        self.config = config
        self.plan = plan
        self.clock = clock
        self.versions = version_facts()  # at the start: a checkout may change before the run ends
        self.curve: list[EvaluationPoint] = []
        self.events: list[Event] = []
        self.gaussians = 0
        self.residual_unseen = 0
        self.diverged: str | None = None
        self._plotting_s = 0.0

    def note(self, events: Iterable[Event]) -> None:
        """Keep what happened."""
        self.events += events

    def point(
        self, iteration: int, metrics: SplitMetrics, anchors: int, stiffness: Stiffness
    ) -> EvaluationPoint | None:
        """Add the held-out `metrics` at `iteration` to the curve; None where masks leave no view to compare."""
        if metrics.psnr is None or metrics.ssim_3dgs is None:
            return None
        point = EvaluationPoint(
            iteration=iteration,
            train_s=self.clock.train_s(),
            train_cpu_s=self.clock.train_cpu_s,
            total_s=self.clock.total_s(),
            psnr=metrics.psnr,
            rmse=math.sqrt(sum(view.mse for view in metrics.views) / len(metrics.views)),
            ssim_3dgs=metrics.ssim_3dgs,
            views=len(metrics.views),
            gaussians=self.gaussians,
            anchors=anchors,
            step_over_size=stiffness.step_over_size,
            subpixel_share=stiffness.subpixel_share,
        )
        self.curve.append(point)
        return point

    def state(self) -> dict[str, Any]:
        """All of it as JSON, for a checkpoint."""
        return LogState(
            seconds=self.clock.seconds,
            wall_s=self.clock.wall_s(),
            train_cpu_s=self.clock.train_cpu_s,
            curve=tuple(self.curve),
            events=tuple(self.events),
            gaussians=self.gaussians,
            plan=self.plan,
            residual_unseen=self.residual_unseen,
        ).to_json()

    def load(self, state: Mapping[str, Any], *, extended: bool = False) -> None:
        """Continue from what `state()` gave; other keys are ignored. Raises `KeyError` or `ValueError`.

        The predicted cost of a run that was extended since is not that of its new length: it is left out.
        """
        values = LogState.model_validate({name: state[name] for name in LogState.model_fields})
        self.clock = Clock(dict(values.seconds), values.wall_s, values.train_cpu_s)
        self.curve = list(values.curve)
        self.events = list(values.events)
        self.gaussians = values.gaussians
        self.plan = values.plan.model_copy(update={"prediction": None}) if extended else values.plan
        self.residual_unseen = values.residual_unseen

    def is_complete(self, iterations: int) -> bool:
        """Whether the metrics document is that of the last of all `iterations`."""
        file = self.folder / METRICS_FILE
        if not file.exists():
            return False
        document = read_metrics(file)
        return document.iterations == iterations and bool(document.splits or not self.capture.val)

    def forget_end(self, iteration: int) -> None:
        """Take back what the end after the last `iteration` adds, so that it can be done again."""
        self.curve = [point for point in self.curve if point.iteration < iteration]
        self.events = [one for one in self.events if not (isinstance(one, Stiff) and one.iteration == iteration)]

    def forget_after(self, iteration: int) -> None:
        """Take back the points of the curve beyond `iteration`, to which training has returned."""
        self.curve = [point for point in self.curve if point.iteration <= iteration]

    def write_run(self) -> None:
        """Write run.json: what is trained, on which capture and with which versions."""
        with self.clock.timed("report"):
            record = RunRecord(
                capture=CaptureSource(
                    path=self.capture.root.resolve(),
                    hash=self.capture.content_hash,
                    kind=self.capture.kind,
                    notes=self.capture.notes,
                ),
                config=self.config,
                plan=self.plan,
                versions=self.versions,
            )
            write_document(self.folder / RECORD_FILE, record)

    def write_metrics(
        self,
        iteration: int,
        iterations_planned: int,
        scene: Scene,
        background: Sequence[float],
        guard: Guard,
        threads: int,
        splits: Mapping[Split, SplitMetrics],
        render_fps: float | None,
        compact: CompactFacts | None = None,
        stiffness: Stiffness | None = None,
    ) -> None:
        """Write metrics.json as of `iteration`, and curve.svg and report/ unless they would take too much time.

        `splits` are the metrics of whole splits and `stiffness` is measured over all training views; these two and
        `compact` only exist once the run has ended. Then the plots are always drawn.
        """
        with self.clock.timed("report"):
            metrics = Metrics(
                splits=dict(splits),
                train_s=self.clock.train_s(),
                train_cpu_s=self.clock.train_cpu_s,
                total_s=self.clock.total_s(),
                wall_s=self.clock.wall_s(),
                phases_s=dict(self.clock.seconds),
                iterations=iteration,
                iterations_planned=iterations_planned,
                gaussians=self.gaussians,
                anchors=scene.scaffold.count,
                bytes=ModelBytes(fp32=scene_bytes(scene), compact=None if compact is None else compact.bytes),
                compact=compact,
                render_fps=render_fps,
                curve=tuple(self.curve),
                events=tuple(self.events),
                plan=self.plan,
                capture=self._capture_facts(background),
                skipped_steps=guard.skipped,
                clipped_steps=guard.clipped,
                rollbacks=sum(isinstance(event, RolledBack) for event in self.events),
                stiffness=None if stiffness is None else _facts(stiffness),
                diverged=self.diverged is not None,
                diverged_reason=self.diverged,
                machine=machine_facts(threads),
                versions=self.versions,
                seed=self.config.seed,
                hashes=Hashes(config=config_hash(self.config), capture=self.capture.content_hash),
            )
            write_document(self.folder / METRICS_FILE, metrics)
            if stiffness is not None or self._plotting_s <= MAX_PLOTTING_SHARE * self.clock.train_s():
                self._write_plots(metrics)

    def _write_plots(self, metrics: Metrics) -> None:
        started = time.perf_counter()
        curve = curve_figure([point.model_dump(mode="json") for point in metrics.curve])
        write_text(self.folder / CURVE_FILE, svg(curve))
        report_training(run_names([self.folder])[0], metrics, self.config, self.folder / "report")
        self._plotting_s += time.perf_counter() - started

    def _capture_facts(self, background: Sequence[float]) -> CaptureFacts:
        camera = self.capture.train[0].camera
        red, green, blue = background
        return CaptureFacts(
            frames={split: len(self.capture.split(split)) for split in SPLITS},
            times=len(self.capture.times),
            width=camera.width,
            height=camera.height,
            background=(red, green, blue),
            notes=self.capture.notes,
        )


def _facts(stiffness: Stiffness) -> StiffnessFacts:
    return StiffnessFacts(
        step_over_size=stiffness.step_over_size,
        subpixel_share=stiffness.subpixel_share,
        views=stiffness.views,
        stiff=stiffness.stiff,
    )
