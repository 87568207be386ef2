"""Trainer: an iterator of StepReports over the paper's two phases.

Never prints, logs, saves or asks: whoever iterates decides. Knows nothing of files.
"""

from __future__ import annotations

import copy
import math
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from graings.capture.capture import Capture, Frame
from graings.capture.images import ImageStore
from graings.config import TrainConfig
from graings.config.schedule import Phase, phases
from graings.errors import DivergedError
from graings.random import RandomStreams
from graings.raster.photometric import photometric
from graings.raster.result import RenderResult
from graings.render import draw, low_pass
from graings.report.events import (
    BackgroundFound,
    Event,
    GradientsClipped,
    LowResolutionStarted,
    OpacityReset,
    RolledBack,
    StepSkipped,
    TimeWindowStarted,
)
from graings.scene.scene import Composition, Scene
from graings.training import losses
from graings.training.curriculum.image_pyramid import ImagePyramid
from graings.training.curriculum.time_window import TimeWindow
from graings.training.density.control import DensityControl
from graings.training.guard.collapse import RESET_OPACITY, Collapse, raise_opacity
from graings.training.guard.guard import Gradient, Guard, first_not_finite
from graings.training.guard.snapshots import Snapshots
from graings.training.guard.stiffness import step_over_size
from graings.training.initialization.initial_scene import make_scene
from graings.training.optimizer import Optimizer
from graings.training.parameter_average import ParameterAverage
from graings.training.regularisers import regularisers
from graings.training.view_sampler import ViewSampler

# Every time training goes back, it goes on with this share of the rates.
RATE_CUT = 0.5

# What the guard calls the gradients of the projected centres, which growth looks at.
SCREEN = "screen"


@dataclass(frozen=True, slots=True)
class StepReport:
    """One step: what it did and what it cost.

    `psnr`, in dB, is the mean of the training views just drawn; `gaussians` is how many any of them drew. `seconds` are
    those on the wall, `cpu_s` those that the threads of this process computed.
    """

    iteration: int
    iterations: int
    phase: str
    loss: float
    psnr: float
    gaussians: int
    anchors: int
    seconds: float
    cpu_s: float
    events: tuple[Event, ...] = ()


class Trainer:
    """Optimises a scene on a capture. Iterating trains one step at a time from `iteration` on.

    `before` iterations of a run were spent before these; reports and messages count them, `iteration` and the schedule
    of `config` do not.
    """

    def __init__(self, capture: Capture, images: ImageStore, config: TrainConfig, before: int = 0) -> None:
        self.capture = capture
        self.before = before
        self.images = images
        self.config = config
        self.background = config.capture.background_rgb()
        self.phases = phases(config)
        self.streams = RandomStreams(config.seed)
        self.sampler = ViewSampler(len(capture.train), self.streams["sampler"])
        self.times = capture.times
        self.iteration = 0
        start = make_scene(capture, images, config, self.streams)
        self.scene = start.scene
        self.start_notes = start.notes
        self.window = TimeWindow(config, [frame.time for frame in capture.train], start.time_window)
        self.pyramid = ImagePyramid(config, capture.train, float(self.scene.extent))
        self.snapshots = Snapshots()
        self._attach(start.voxel_size)

    def _attach(self, voxel_size: float) -> None:
        """Everything whose shape follows the scene, and what watches over it."""
        views = min(self.config.batch, len(self.capture.train))
        self.optimizer = Optimizer(self.scene, self.config, joint_from=self.phases[-1].first - 1, views=views)
        self.density = DensityControl(self.config, self.scene, voxel_size)
        self.guard = Guard(self.config.guard)
        self.collapse = Collapse()
        self.average = ParameterAverage()
        self.step_over_size: float | None = None  # of the last step that was measured and stands

    def __iter__(self) -> Iterator[StepReport]:
        while self.iteration < self.config.iterations:
            yield self.step()

    @property
    def run_iteration(self) -> int:
        """Iterations of the run done, those of an earlier attempt included."""
        return self.before + self.iteration

    def phase(self, iteration: int) -> Phase:
        """The phase that `iteration` (from 1) belongs to."""
        return next(phase for phase in self.phases if iteration <= phase.last)

    def step(self) -> StepReport:
        """Take one step. Raises `DivergedError` when training went wrong once more than it may go back."""
        started, computed = time.perf_counter(), time.process_time()
        if len(self.snapshots) == 0:
            self._take_snapshot()  # the beginning, or the checkpoint that training goes on from
        self.iteration += 1
        phase = self.phase(self.iteration)
        self.scene.temporal = phase.temporal
        self._look()
        frames = self.next_frames()
        targets = [torch.from_numpy(self.images.rgb(frame)) for frame in frames]
        for view in self._upcoming():
            self.images.prefetch(self.pyramid.at(self.iteration + 1).frames[view])

        compositions = self.scene.compose_together([(frame.camera.center, frame.time) for frame in frames])
        children = compositions[0].children
        offsets = [torch.zeros(len(children), 2, requires_grad=True) for _ in frames]
        results = [
            draw(composition, frame.camera, self.background, means2d_offset=offset)
            for composition, frame, offset in zip(compositions, frames, offsets, strict=True)
        ]
        squared = self._squared_weight()
        differences = torch.stack(
            [
                photometric(r.color, target, self.config.loss.ssim, squared)
                for r, target in zip(results, targets, strict=True)
            ]
        )
        loss = self.regularisers(compositions, [frame.time for frame in frames]) + differences.mean()
        loss = loss + self._alpha_term(frames, results)
        # With nothing drawn and no regulariser there is nothing to differentiate; the guard still sees the loss.
        if loss.requires_grad:
            loss.backward()

        events = self._opening()
        names = tuple(frame.name for frame in frames)
        gradients = self.optimizer.gradients()
        gradients += [Gradient("the projected centres", SCREEN, o.grad) for o in offsets if o.grad is not None]
        errors = [float(functional.mse_loss(r.color.detach(), t)) for r, t in zip(results, targets, strict=True)]
        # Compared with the losses of steps before squares joined in.
        verdict = self.guard.check_step(self.iteration, loss.detach() - squared * statistics.mean(errors), gradients)
        if verdict.non_finite is None:
            for group, (norm, limit) in verdict.limits.items():
                events.append(
                    GradientsClipped(iteration=self.run_iteration, group=group, norm=norm, limit=limit, views=names)
                )
                if group != SCREEN:
                    self.optimizer.limit(group, self.config.guard.clip, limit)
            # A step out of all proportion says nothing about where anchors are wanted.
            if self.density.watches(self.iteration) and not verdict.limits:
                for frame, composition, offset, result in zip(frames, compositions, offsets, results, strict=True):
                    if offset.grad is not None:
                        self.density.statistics.observe(
                            children,
                            offset.grad * len(frames),  # of the view's own loss, not of the mean
                            result.radii.amax(-1) > 0,
                            composition.opacities,
                            (frame.camera.width, frame.camera.height),
                        )
            self.optimizer.step(self.iteration)
            if self.iteration % self.config.guard.check_every == 0 or self.iteration == self.config.iterations:
                self._measure(compositions[0], frames[0])
        else:
            self.optimizer.clear()
            events.append(
                StepSkipped(
                    iteration=self.run_iteration,
                    non_finite=verdict.non_finite,
                    views=names,
                    times=tuple(frame.time for frame in frames),
                )
            )
        events += self._adapt()
        events += self._watch(len(children), float(differences.detach().amax()))
        self._settle()
        return StepReport(
            iteration=self.run_iteration,
            iterations=self.before + self.config.iterations,
            phase=phase.name,
            loss=float(loss.detach()),
            psnr=statistics.mean(-10.0 * math.log10(max(mse, 1e-10)) for mse in errors),
            gaussians=len(children),
            anchors=self.scene.scaffold.count,
            seconds=time.perf_counter() - started,
            cpu_s=time.process_time() - computed,
            events=tuple(events),
        )

    def _alpha_term(self, frames: Sequence[Frame], results: Sequence[RenderResult]) -> Tensor:
        """Of the views that have an alpha channel, with this run's weight; a view without one counts as right."""
        total, weight = torch.zeros(()), self.config.loss.alpha
        if weight == 0:
            return total
        for frame, result in zip(frames, results, strict=True):
            seen = self.images.alpha(frame)
            if seen is not None:
                total = total + losses.alpha(result.alpha, torch.from_numpy(seen))
        return total * (weight / len(frames))

    def _squared_weight(self) -> float:
        """Of the mean squared error in this step: none while anchors grow, or they would grow wherever it is large."""
        config = self.config
        return config.loss.squared if self.iteration > config.scaled(config.density.grow_until) else 0.0

    @torch.no_grad()
    def _measure(self, before: Composition, frame: Frame) -> None:
        """How far the step just taken moved what `frame` shows."""
        after = self.scene.compose(frame.camera.center, frame.time)
        self.step_over_size = step_over_size(
            before.gaussians, after.gaussians, frame.camera, low_pass(before, frame.camera)
        )

    def _opening(self) -> list[Event]:
        """At the first step, what was decided before it."""
        if self.iteration > 1:
            return []
        iteration = self.run_iteration
        events: list[Event] = [note.at(iteration) for note in self.start_notes]
        if self.background != (1.0, 1.0, 1.0):
            events.append(BackgroundFound(iteration=iteration, color=self.background))
        if (share := self.window.share(1)) < 1:
            events.append(TimeWindowStarted(iteration=iteration, share=share))
        if (times := self.pyramid.at(1).times) > 1:
            events.append(LowResolutionStarted(iteration=iteration, factor=times))
        return events

    def _look(self) -> None:
        """Have the scene drawn as the pictures of this iteration ask for, whichever size it was at before."""
        sampling = self.pyramid.at(self.iteration).sampling
        if sampling != self.scene.sampling:
            self.scene.sampling = sampling
            self.guard.trend.begin()

    def next_frames(self) -> list[Frame]:
        """The views of the next step: of those that take part by now at most `batch`, shared out evenly over a pass."""
        while not (views := self._upcoming()):
            self.sampler.begin()  # what is left of this pass does not take part
        while self.sampler.next() != views[-1]:
            pass  # those passed over do not take part
        frames = self.pyramid.at(self.iteration).frames
        return [frames[view] for view in views]

    def _upcoming(self) -> list[int]:
        """The views of the next step, as far as this pass goes; none at its end."""
        remaining = self.sampler.remaining.tolist()
        taking_part = [view for view in remaining if self.window.has(view, self.iteration)]
        steps = math.ceil(len(taking_part) / self.config.batch)
        return taking_part[: math.ceil(len(taking_part) / steps)] if steps else []

    def regularisers(self, compositions: Sequence[Composition], moments: Sequence[float]) -> Tensor:
        """The terms on the model itself, with this run's weights and streams."""
        return regularisers(self.scene, compositions, moments, self.times, self.config.loss, self.streams)

    def _adapt(self) -> list[Event]:
        """Grow and prune where the schedule says so; returns what happened."""
        events: list[Event] = []
        if self.density.grows(self.iteration):
            born, events = self.density.grow(self.run_iteration, self.scene, self.optimizer, self.streams["growth"])
            if born > 0:
                self.guard.trend.grown()
        if self.density.prunes(self.iteration):
            events += self.density.prune(self.run_iteration, self.scene, self.optimizer)
        return events

    def _watch(self, drawn: int, difference: float) -> list[Event]:
        """Roll back where training went wrong; returns what happened."""
        events: list[Event] = []
        scaffold, every = self.scene.scaffold, self.config.guard
        problem = self.guard.problem()
        last_of_pass = not self._upcoming()
        if self.collapse.observe(drawn, scaffold.count * scaffold.slots, difference, last_of_pass=last_of_pass):
            problem = problem or self._lost()
            if problem is None and not self.collapse.raised:
                shift = raise_opacity(self.scene)
                self.collapse.raised = True
                events.append(OpacityReset(iteration=self.run_iteration, opacity=RESET_OPACITY, shift=shift))
            elif problem is None and self.collapse.missed:  # where the pictures are empty, so may the scene be
                problem = "nothing was drawn any more, though there was something to see"
        due = self.iteration % every.snapshot_every == 0
        if problem is None and (due or self.iteration % every.check_every == 0):
            problem = self._lost()
        if problem is not None:
            events.append(self._go_back(problem))
        elif due and self.guard.trend.healthy:
            self._take_snapshot()
        return events

    def _settle(self) -> None:
        """Average the last steps, after which no anchor comes or goes, and end with their mean."""
        config = self.config.density
        last_change = max(self.config.average_from, config.grow_until, config.prune_until)
        if self.iteration > self.config.scaled(last_change):
            self.average.add(self.scene)
            if self.iteration == self.config.iterations:
                self.average.apply(self.scene)

    def check(self) -> list[Event]:
        """Make sure that the scene is finite before somebody looks at it or saves it, going back where it is not.

        Returns what happened. Raises `DivergedError` as `step` does.
        """
        problem = self._lost()
        return [] if problem is None else [self._go_back(problem)]

    def _lost(self) -> str | None:
        """Which parameter or moment holds a number that is none, in words, or None."""
        tensors = {name: values.detach() for name, values in self.scene.named_parameters()}
        name = first_not_finite(tensors | self.optimizer.state())
        return None if name is None else f"{name} was not finite any more"

    def _take_snapshot(self) -> None:
        self.snapshots.take(self.iteration, self.scene, *self.state())

    def _go_back(self, problem: str) -> RolledBack:
        """Restore a good moment and go on more slowly and in another order of views. The iterations are spent."""
        if self.guard.rollbacks >= self.config.guard.rollbacks:
            raise DivergedError(
                f"Training diverged at iteration {self.before + self.iteration} after going back "
                f"{self.guard.rollbacks} times: {problem}. The best model is kept. "
                "Train again with smaller rates (`rates`)."
            )
        iteration, before, raised = self.iteration, self.guard, self.collapse.raised
        snapshot = self.snapshots.back()
        self.load(copy.deepcopy(snapshot.scene), snapshot.tensors, snapshot.facts)
        self.iteration = iteration
        self.guard.rolled_back(before)
        self.guard.rollbacks += 1
        self._look()
        self.collapse.raised = raised
        self._slow_down()
        self.sampler = self._sampler()
        return RolledBack(
            iteration=self.run_iteration,
            to_iteration=self.before + snapshot.iteration,
            reason=problem,
            rate_factor=self.optimizer.damping,
        )

    def _slow_down(self) -> None:
        self.optimizer.damping = RATE_CUT**self.guard.rollbacks

    def _sampler(self) -> ViewSampler:
        """Views in the order of this attempt: the one that failed is not repeated."""
        attempt = self.guard.rollbacks
        return ViewSampler(len(self.capture.train), self.streams[f"sampler.{attempt}" if attempt else "sampler"])

    def restore(self) -> None:
        """Return to the newest good moment, and its iteration, for good: the guard has given up.

        What has happened since stays counted, and the rates stay as low as they were.
        """
        snapshot, before = self.snapshots.newest, self.guard
        self.adopt(copy.deepcopy(snapshot.scene), snapshot.tensors, snapshot.facts, before)

    def adopt(self, scene: Scene, tensors: dict[str, Tensor], facts: dict[str, Any], before: Guard) -> None:
        """As `load`, for an earlier moment of the same run whose guard is `before`."""
        self.load(scene, tensors, facts)
        self.guard.rolled_back(before)
        self._slow_down()
        self.sampler = self._sampler()

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything beside the scene that the next step depends on: tensors and JSON."""
        tensors = {f"adam/{name}": value for name, value in self.optimizer.state().items()}
        statistics, growth = self.density.state()
        tensors |= {f"statistics/{name}": value for name, value in statistics.items()}
        tensors |= {f"streams/{name}": value for name, value in self.streams.state().items()}
        tensors["sampler/remaining"] = self.sampler.remaining
        means, average = self.average.state()
        tensors |= {f"average/{name}": value for name, value in means.items()}
        norms, guard = self.guard.state()
        tensors |= {f"guard/{name}": value for name, value in norms.items()}
        facts = {
            "iteration": self.iteration,
            **growth,
            "guard": guard,
            "collapse": self.collapse.state(),
            "average": average,
            "step_over_size": self.step_over_size,
        }
        return tensors, facts

    def load(self, scene: Scene, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
        """Continue from a scene and what `state()` gave with it."""
        self.scene = scene
        # First points found again, with another library or on another CPU, need not have quite the same extent.
        self.pyramid = ImagePyramid(self.config, self.capture.train, float(scene.extent))
        self._attach(float(facts["voxel_size"]))
        parts: dict[str, dict[str, Tensor]] = {
            name: {} for name in ("adam", "statistics", "streams", "sampler", "guard", "average")
        }
        for key, value in tensors.items():
            part, _, name = key.partition("/")
            parts[part][name] = value
        self.optimizer.load(parts["adam"])
        self.density.load(parts["statistics"], facts)
        self.streams.load(parts["streams"])
        if "guard" in facts:  # older checkpoints have none: their guard begins with them
            self.guard.load(parts["guard"], facts["guard"])
            self.collapse.load(facts["collapse"])
        if "average" in facts:  # older ones did not average either
            self.average.load(parts["average"], facts["average"])
        self.step_over_size = facts.get("step_over_size")
        self._slow_down()
        self.sampler = self._sampler()
        self.sampler.remaining = parts["sampler"]["remaining"].clone()
        self.iteration = int(facts["iteration"])
