"""Trainer: the paper's two-phase optimisation of a scene, one step at a time.

It never prints, logs or saves: whoever iterates over it decides.
"""

from __future__ import annotations

import copy
import math
import statistics
import time
from collections.abc import Iterator, Sequence
from typing import Any, Final

import torch
from torch import Tensor

from graings.camera.sampling_rate import SamplingRate
from graings.capture.capture import Frame
from graings.errors import DivergedError
from graings.plan.rules import QUIET_GROWTHS
from graings.render import draw, low_pass
from graings.report.events import (
    Event,
    GradientsClipped,
    GrowthCapped,
    GrowthQuiet,
    OpacityReset,
    RolledBack,
    StepSkipped,
)
from graings.report.start_events import BackgroundFound, LowResolutionStarted, MotionFound, TimeWindowStarted
from graings.scene.perceptron import bfloat16_products
from graings.scene.scene import Composition, Scene
from graings.training.guard.collapse import RESET_OPACITY, raise_opacity
from graings.training.guard.guard import Gradient, Guard, StepCheck, first_not_finite
from graings.training.guard.stiffness import step_over_size
from graings.training.parameter_average import ParameterAverage
from graings.training.step_report import StepReport
from graings.training.trainer_state import TrainerState

# Name that the guard gives to the gradients of the projected centres, which growth observes.
SCREEN: Final = "screen"

# A growth tells whether anchors are still needed where this share of the drawn children was drawn often enough to grow.
MIN_JUDGED_FRACTION: Final = 0.5


class Trainer(TrainerState):
    """Optimises a scene on a capture. Iterating takes one step at a time from `iteration` on."""

    def __iter__(self) -> Iterator[StepReport]:
        while self.iteration < self.config.iterations:
            yield self.step()

    def step(self) -> StepReport:
        """Take one step. Raises `DivergedError` when training diverged and may not roll back any more."""
        started, computed = time.perf_counter(), time.process_time()
        if len(self.snapshots) == 0:
            self._take_snapshot()  # the initial scene, or the checkpoint that training continues from
        self.iteration += 1
        phase = self.phase(self.iteration)
        self.scene.temporal = phase.temporal
        self._set_sampling_rate(self.pyramid.at(self.iteration).sampling)
        if self.window.stage(self.iteration) != self.window.stage(self.iteration - 1):
            self.guard.trend.begin()  # losses of more times do not compare
        events: list[Event] = self._initial_events() if self.iteration == 1 else []

        # sample views
        frames = self.views.next(self.iteration)
        for frame in self.views.upcoming_frames(self.iteration):
            self.images.prefetch(frame)

        # compose the Gaussians of each view at its time, and draw them
        with bfloat16_products(self.rounds_products):
            compositions = self.scene.compose_together([(frame.camera.center, frame.time) for frame in frames])
        drawn = len(compositions[0].children)
        offsets = [torch.zeros(drawn, 2, requires_grad=True) for _ in frames]
        results = [
            draw(composition, frame.camera, self.background, means2d_offset=offset)
            for composition, frame, offset in zip(compositions, frames, offsets, strict=True)
        ]

        # losses and gradients; with nothing drawn and no regulariser there is nothing to differentiate
        with bfloat16_products(self.rounds_products):
            loss = self.objective(self.scene, frames, compositions, results, self.iteration)
        if loss.total.requires_grad:
            loss.total.backward()

        # accept or skip the step
        gradients = self.optimizer.gradients()
        gradients += [Gradient("the projected centres", SCREEN, o.grad) for o in offsets if o.grad is not None]
        check = self.guard.check_step(self.iteration, loss.without_squared, gradients)
        if check.non_finite is None:
            events += self._limit_gradients(check, frames)
            # A step far above the usual size gives no evidence of where anchors are needed.
            if self.watches() and not check.limits:
                masks = [self.images.valid(frame) for frame in frames]
                self.density.observe(frames, compositions, results, offsets, masks)
            self.optimizer.step(self.iteration)
            self._measure_step(compositions[0], frames[0])
        else:
            self.optimizer.clear()
            events.append(
                StepSkipped(
                    iteration=self.run_iteration,
                    non_finite=check.non_finite,
                    views=_names(frames),
                    times=tuple(frame.time for frame in frames),
                )
            )

        # adapt the anchors, and check the health of the scene
        events += self._adapt()
        events += self._check_health(drawn, float(loss.photometric.detach().amax()))
        self._average()
        return StepReport(
            iteration=self.run_iteration,
            iterations=self.iterations_before + self.config.iterations,
            phase=phase.name,
            loss=float(loss.total.detach()),
            psnr=statistics.mean(-10.0 * math.log10(max(mse, 1e-10)) for mse in loss.mse),
            gaussians=drawn,
            anchors=self.scene.scaffold.count,
            seconds=time.perf_counter() - started,
            cpu_s=time.process_time() - computed,
            events=tuple(events),
        )

    def _initial_events(self) -> list[Event]:
        """What was decided before the first step."""
        iteration = self.run_iteration
        events: list[Event] = [note.at(iteration) for note in self.notes]
        if self.background != (1.0, 1.0, 1.0):
            events.append(BackgroundFound(iteration=iteration, color=self.background))
        if (share := self.window.share(1)) < 1:
            events.append(TimeWindowStarted(iteration=iteration, share=share))
        if (factor := self.pyramid.at(1).factor) > 1:
            events.append(LowResolutionStarted(iteration=iteration, factor=factor))
        if self.tracks is not None and self.iterations_before == 0:
            events.append(MotionFound(iteration=iteration, tracked_points=len(self.tracks.points)))
        return events

    def _set_sampling_rate(self, sampling: SamplingRate) -> None:
        if sampling != self.scene.sampling:
            self.scene.sampling = sampling
            self.guard.trend.begin()  # losses of another resolution do not compare

    def _limit_gradients(self, check: StepCheck, frames: Sequence[Frame]) -> list[Event]:
        events: list[Event] = []
        for group, (norm, limit) in check.limits.items():
            iteration, views = self.run_iteration, _names(frames)
            events.append(GradientsClipped(iteration=iteration, group=group, norm=norm, limit=limit, views=views))
            if group != SCREEN:
                self.optimizer.limit(group, self.config.guard.clip, limit)
        return events

    @torch.no_grad()
    def _measure_step(self, before: Composition, frame: Frame) -> None:
        """Every so often, how far the step just taken moved the Gaussians of `frame`, relative to their size."""
        if self.iteration % self.config.guard.check_every == 0 or self.iteration == self.config.iterations:
            after = self.scene.compose(frame.camera.center, frame.time)
            blur = low_pass(before, frame.camera)
            self.step_over_size = step_over_size(before.gaussians, after.gaussians, frame.camera, blur)

    def _adapt(self) -> list[Event]:
        """Grow and prune anchors where the schedule says so; returns the events."""
        events: list[Event] = []
        if self.density.grows(self.iteration) and not self.growth_ended:
            judged = self._can_judge_growth()
            grown, events = self.density.grow(self.run_iteration, self.scene, self.optimizer, self.streams["growth"])
            if grown > 0:
                self.guard.trend.grown()
            if judged:
                events += self._note_quiet(grown > 0 or any(isinstance(event, GrowthCapped) for event in events))
        if self.density.prunes(self.iteration):
            events += self.density.prune(self.run_iteration, self.scene, self.optimizer)
        return events

    def _can_judge_growth(self) -> bool:
        """Whether most children were drawn often enough to grow, at all times of the clip and full resolution."""
        if self.window.share(self.iteration) < 1 or self.pyramid.at(self.iteration).factor > 1:
            return False  # growth may begin again when they come
        drawn = self.density.statistics.drawn
        often = int((drawn > self.config.density.min_observations).sum())
        return often > 0 and often >= MIN_JUDGED_FRACTION * int((drawn > 0).sum())

    def _note_quiet(self, wanted: bool) -> list[Event]:
        """Count growths in a row that added no anchor; `wanted` says whether any qualified."""
        self.quiet_growths = 0 if wanted else self.quiet_growths + 1
        if self.quiet_growths != QUIET_GROWTHS or "growth" in self.config.plan.keep:
            return []
        self.growth_ended = self.config.plan.mode == "aggressive"
        return [GrowthQuiet(iteration=self.run_iteration, growths=self.quiet_growths, ended=self.growth_ended)]

    def _average(self) -> None:
        """Average the parameters of the last steps, in which no anchor is added or removed, and end with the mean."""
        config = self.config.density
        last_change = max(self.config.average_from, config.grow_until, config.prune_until)
        if self.iteration <= self.config.scaled(last_change):
            if self.average.steps > 0:  # of the end of a run that was extended: anchors change again
                self.average = ParameterAverage()
            return
        self.average.add(self.scene)
        if self.iteration == self.config.iterations:
            self.average.apply(self.scene)

    def _check_health(self, drawn: int, difference: float) -> list[Event]:
        """Detect a collapsed or diverged scene and roll back; take a snapshot of a healthy one. Returns the events."""
        events: list[Event] = []
        scaffold, config = self.scene.scaffold, self.config.guard
        problem = self.guard.problem()
        end_of_pass = not self.views.upcoming(self.iteration)
        slots = scaffold.count * scaffold.slots
        collapsed = self.collapse.observe(drawn, slots, difference, last_of_pass=end_of_pass)
        if collapsed and not config.skip_only:
            problem = problem or self._non_finite()
            if problem is None and not self.collapse.raised:
                shift = raise_opacity(self.scene)
                self.collapse.raised = True
                events.append(OpacityReset(iteration=self.run_iteration, opacity=RESET_OPACITY, shift=shift))
            elif problem is None and self.collapse.missed:  # where the images are empty, the scene may be too
                problem = "no Gaussian was drawn any more, though the images are not empty"
        snapshot_due = self.iteration % config.snapshot_every == 0
        if problem is None and (snapshot_due or self.iteration % config.check_every == 0):
            problem = self._non_finite()
        if problem is not None:
            events.append(self._roll_back(problem))
        elif snapshot_due and self.guard.trend.healthy:
            self._take_snapshot()
        return events

    def check(self) -> list[Event]:
        """Make sure that the scene is finite before it is rendered or saved; rolls back where it is not.

        Returns the events. Raises `DivergedError` as `step` does.
        """
        problem = self._non_finite()
        return [] if problem is None else [self._roll_back(problem)]

    def _non_finite(self) -> str | None:
        """The name of a parameter or moment with a NaN or infinity, in a sentence; None where there is none."""
        tensors = {name: values.detach() for name, values in self.scene.named_parameters()}
        name = first_not_finite(tensors | self.optimizer.state())
        return None if name is None else f"{name} was not finite any more"

    def _take_snapshot(self) -> None:
        self.snapshots.take(self.iteration, self.scene, *self.state())

    def _roll_back(self, problem: str) -> RolledBack:
        """Restore a snapshot and continue with lower rates and another order of views. The iterations are spent."""
        if not self.guard.may_roll_back:
            raise DivergedError(
                f"Training diverged at iteration {self.run_iteration} after "
                f"{self.guard.rollbacks} rollbacks: {problem}. The best model is kept. "
                "Train again with smaller rates (`rates`)."
            )
        iteration, before, raised = self.iteration, self.guard, self.collapse.raised
        snapshot = self.snapshots.back()
        self.load(copy.deepcopy(snapshot.scene), snapshot.tensors, snapshot.facts)
        self.iteration = iteration
        self.guard.rolled_back(before)
        self.guard.rollbacks += 1
        self._set_sampling_rate(self.pyramid.at(self.iteration).sampling)
        if self.window.stage(self.iteration) != self.window.stage(snapshot.iteration):
            self.guard.trend.begin()
        self.collapse.raised = raised
        self._slow_down()
        self._restart_views()
        return RolledBack(
            iteration=self.run_iteration,
            to_iteration=self.iterations_before + snapshot.iteration,
            reason=problem,
            rate_factor=self.optimizer.damping,
        )

    def keep_anchors(self, keep: Tensor) -> None:
        """Remove all anchors but those of the mask `keep` [A]."""
        self.optimizer.keep(keep)
        self.density.statistics.resize(keep=keep)
        self.average = ParameterAverage()

    def restore(self) -> None:
        """Return to the newest snapshot, and its iteration, for good: training has diverged."""
        snapshot, before = self.snapshots.newest, self.guard
        self.adopt(copy.deepcopy(snapshot.scene), snapshot.tensors, snapshot.facts, before)

    def adopt(self, scene: Scene, tensors: dict[str, Tensor], facts: dict[str, Any], before: Guard) -> None:
        """As `load`, for an earlier moment of the same run; the counts of the guard `before` stay."""
        self.load(scene, tensors, facts)
        self.guard.rolled_back(before)
        self._slow_down()
        self._restart_views()


def _names(frames: Sequence[Frame]) -> tuple[str, ...]:
    return tuple(frame.name for frame in frames)
