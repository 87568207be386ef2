"""TrainerState: everything that the next step of a training depends on, and its form in a checkpoint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, TypeVar

from torch import Tensor

from graings.capture.capture import Capture
from graings.capture.images import ImageStore
from graings.config import TrainConfig
from graings.config.schedule import Phase, phases
from graings.random import RandomStreams
from graings.report.start_events import PointsInitialized
from graings.scene.scene import Scene
from graings.training.curriculum.image_pyramid import ImagePyramid
from graings.training.curriculum.time_window import TimeWindow
from graings.training.density.control import DensityControl
from graings.training.guard.collapse import Collapse
from graings.training.guard.guard import Guard
from graings.training.guard.snapshots import Snapshots
from graings.training.initialization.initial_scene import make_scene
from graings.training.network_precision import rounds_products
from graings.training.objective import Objective
from graings.training.optimizer import Optimizer
from graings.training.parameter_average import ParameterAverage
from graings.training.tensor_groups import joined, split
from graings.training.tracks.motion_tracks import MotionTracks
from graings.training.view_batches import ViewBatches
from graings.training.view_sampler import ViewSampler

State = TypeVar("State", bound="TrainerState")

# Factor on the learning rates after each rollback.
RATE_CUT: Final = 0.5

# Groups of the tensors of a checkpoint beside the scene.
GROUPS: Final = ("adam", "statistics", "streams", "sampler", "average", "guard", "tracks")


class TrainerState:
    """A scene in training with its optimiser, random streams, schedules and guard.

    Make it with `start` or `resume`. `iterations_before` are those of a run before a restart: reports count them,
    `iteration` and the schedule of `config` do not. `time_window` is the share of the clip that training begins with,
    `notes` are what initialization decided, for the first report. `tracks` are of what the run has missed before.
    """

    def __init__(
        self,
        capture: Capture,
        images: ImageStore,
        config: TrainConfig,
        scene: Scene,
        *,
        streams: RandomStreams,
        voxel_size: float,
        time_window: float,
        notes: Sequence[PointsInitialized] = (),
        iterations_before: int = 0,
        tracks: MotionTracks | None = None,
    ) -> None:
        self.capture = capture
        self.images = images
        self.config = config
        self.streams = streams
        self.iterations_before = iterations_before
        self.notes = tuple(notes)
        self.iteration = 0
        self.background = config.capture.background_rgb()
        self.rounds_products = rounds_products(config)
        self.phases = phases(config)
        self.tracks = tracks
        self.objective = Objective(config, images, capture.times, streams, tracks)
        self.window = TimeWindow(config, [frame.time for frame in capture.train], time_window)
        self.snapshots = Snapshots()
        self._attach(scene, voxel_size)

    @classmethod
    def start(
        cls: type[State],
        capture: Capture,
        images: ImageStore,
        config: TrainConfig,
        iterations_before: int = 0,
        tracks: MotionTracks | None = None,
    ) -> State:
        """A trainer of a new scene. Raises `CaptureError` where no image shows anything."""
        rounds_products(config)  # refused before the first anchors are made, which takes longer
        streams = RandomStreams(config.seed)
        initial = make_scene(capture, images, config, streams, tracks)
        return cls(
            capture,
            images,
            config,
            initial.scene,
            streams=streams,
            voxel_size=initial.voxel_size,
            time_window=initial.time_window,
            notes=initial.notes,
            iterations_before=iterations_before,
            tracks=tracks,
        )

    @classmethod
    def resume(
        cls: type[State],
        capture: Capture,
        images: ImageStore,
        config: TrainConfig,
        scene: Scene,
        tensors: dict[str, Tensor],
        facts: dict[str, Any],
        iterations_before: int = 0,
    ) -> State:
        """A trainer that continues from `scene` and what `state` returned with it."""
        trainer = cls(
            capture,
            images,
            config,
            scene,
            streams=RandomStreams(config.seed),
            voxel_size=float(facts["voxel_size"]),
            time_window=float(facts["time_window"]),
            notes=[PointsInitialized.model_validate(note) for note in facts["notes"]],
            iterations_before=iterations_before,
            tracks=MotionTracks.of_tensors(split(tensors, GROUPS)["tracks"]),
        )
        trainer.load(scene, tensors, facts)
        return trainer

    def _attach(self, scene: Scene, voxel_size: float) -> None:
        """Everything whose shape follows the scene, and what watches over it."""
        self.scene = scene
        self.pyramid = ImagePyramid(self.config, self.capture.train, float(scene.extent))
        views = min(self.config.batch, len(self.capture.train))
        self.optimizer = Optimizer(scene, self.config, joint_from=self.phases[-1].first - 1, views=views)
        self.density = DensityControl(self.config, scene, voxel_size)
        self.guard = Guard(self.config.guard)
        self.collapse = Collapse()
        self.average = ParameterAverage()
        self.quiet_growths = 0  # growths in a row that added no anchor
        self.growth_ended = False
        self.step_over_size: float | None = None  # of the last step that was measured and not rolled back
        self._restart_views()

    def _restart_views(self) -> None:
        """Views in a new order; after a rollback in another one, so that the failed step is not repeated."""
        attempt = self.guard.rollbacks
        stream = self.streams[f"sampler.{attempt}" if attempt else "sampler"]
        sampler = ViewSampler(len(self.capture.train), stream)
        self.views = ViewBatches(self.config.batch, self.window, self.pyramid, sampler)

    @property
    def run_iteration(self) -> int:
        """Iterations of the run done, those before a restart included."""
        return self.iterations_before + self.iteration

    def phase(self, iteration: int) -> Phase:
        """The phase that `iteration` (from 1) belongs to."""
        return next(phase for phase in self.phases if iteration <= phase.last)

    def watches(self) -> bool:
        """Whether this iteration is observed for the next growth or pruning."""
        growing = self.iteration <= self.config.scaled(self.config.density.grow_until)
        return self.density.watches(self.iteration) and not (growing and self.growth_ended)

    def drop_residual(self) -> None:
        """Go on without the residual field. Everything else keeps its values, moments and random numbers."""
        state, joint_from = self.optimizer.state(), self.phases[-1].first - 1
        self.scene.residual = None
        self.scene.config = self.scene.config.model_copy(update={"residual": False})
        views, damping = min(self.config.batch, len(self.capture.train)), self.optimizer.damping
        self.optimizer = Optimizer(self.scene, self.config, joint_from=joint_from, views=views)
        self.optimizer.damping = damping
        self.optimizer.load({name: value for name, value in state.items() if not name.startswith("residual.")})

    def _slow_down(self) -> None:
        self.optimizer.damping = RATE_CUT**self.guard.rollbacks

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything beside the scene that the next step depends on: tensors and JSON."""
        statistics, density = self.density.state()
        means, average = self.average.state()
        norms, guard = self.guard.state()
        tensors = joined(
            {
                "adam": self.optimizer.state(),
                "statistics": statistics,
                "streams": self.streams.state(),
                "sampler": {"remaining": self.views.sampler.remaining},
                "average": means,
                "guard": norms,
                "tracks": {} if self.tracks is None else self.tracks.tensors(),
            }
        )
        facts = {
            "iteration": self.iteration,
            "time_window": self.window.first,
            "notes": [note.model_dump(mode="json") for note in self.notes],
            **density,
            "guard": guard,
            "collapse": self.collapse.state(),
            "average": average,
            "step_over_size": self.step_over_size,
            "quiet_growths": self.quiet_growths,
            "growth_ended": self.growth_ended,
        }
        return tensors, facts

    def load(self, scene: Scene, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
        """Continue from a scene and what `state()` returned with it."""
        self._attach(scene, float(facts["voxel_size"]))
        parts = split(tensors, GROUPS)
        self.optimizer.load(parts["adam"])
        self.density.load(parts["statistics"], facts)
        self.streams.load(parts["streams"])
        self.guard.load(parts["guard"], facts["guard"])
        self.collapse.load(facts["collapse"])
        self.average.load(parts["average"], facts["average"])
        self.step_over_size = facts["step_over_size"]
        self.quiet_growths = facts["quiet_growths"]
        self.growth_ended = facts["growth_ended"]
        self._slow_down()
        self._restart_views()
        self.views.sampler.remaining = parts["sampler"]["remaining"].clone()
        self.iteration = int(facts["iteration"])
