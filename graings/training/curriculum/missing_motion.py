"""MissingMotion: a moving object that the model does not show after part of the steps, and what helps to find it.

An object that moves farther than its own size is averaged away while the scene is taken for static. In front of a
textured floor or room its masks do not tell, before the first step, how far it moves; what the model leaves out does.
Where that can be followed through the clip, training starts again with tracks of it; else, where it is large in many
views, with a short part of the clip (`time_window`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from graings.capture.capture import Capture
from graings.capture.images import ImageStore
from graings.config import TrainConfig
from graings.evaluation.evaluate import subset
from graings.random import RandomStreams
from graings.report.events import Restarted
from graings.scene.prepared import PreparedScene
from graings.scene.scene import Scene
from graings.training.curriculum.time_window import TimeWindow
from graings.training.initialization.initial_scene import content_half_size
from graings.training.initialization.visual_hull import MIN_VIEWS
from graings.training.tracks.frame_residual import FrameResidual
from graings.training.tracks.motion_tracks import MotionTracks, find_tracks

# Mark of the 30 000 schedule at which to check: later than the slowest of the tested clips had found its objects.
CHECK_AT: Final = 12_500

# After fewer steps even static objects may not have been found; a run whose mark comes earlier is not checked.
MIN_STEPS: Final = 400

# Number of training views to check.
VIEWS: Final = 100

# Above this share of the views an object counts as missing. Seven clips that train well have at most 0.03; three in
# which a moving ball is missing have 0.5 and more.
MAX_MISSING_FRACTION: Final = 0.3

# Shares of the clip to restart with: the first that has enough views.
RESTART_WINDOWS: Final = (0.1, 0.25)


@dataclass(frozen=True, slots=True, eq=False)
class MissingMotion:
    """`share` of the checked views miss a whole object. Start again with `tracks`, if any, within `time_window`."""

    share: float
    time_window: float
    tracks: MotionTracks | None = None

    @classmethod
    def find(cls, scene: Scene, capture: Capture, images: ImageStore, config: TrainConfig) -> MissingMotion | None:
        """What `scene`, in training on `capture`, misses; None where nothing is, or nothing helps."""
        prepared, background = PreparedScene(scene), config.capture.background_rgb()
        residuals = [FrameResidual.of(prepared, frame, images, background) for frame in subset(capture.train, VIEWS)]
        share = sum(residual.missing for residual in residuals) / len(residuals)
        if scene.deformation is not None:
            generator = RandomStreams(config.seed)["tracks"]
            tracks = find_tracks(residuals, content_half_size(capture), scene.scaffold.anchors, generator)
            if tracks is not None:
                return cls(share, 1.0, tracks)
        window = restart_window(config, [frame.time for frame in capture.train])
        return None if window is None or share <= MAX_MISSING_FRACTION else cls(share, window)

    def event(self, iteration: int) -> Restarted:
        """What the report says of the restart after `iteration`."""
        points = 0 if self.tracks is None else len(self.tracks.points)
        return Restarted(
            iteration=iteration, missing_share=self.share, time_window=self.time_window, tracked_points=points
        )


def check_iteration(config: TrainConfig) -> int | None:
    """The iteration after which to check; None where the run is too short."""
    mark = config.scaled(CHECK_AT)
    return mark if mark >= MIN_STEPS else None


def restart_window(config: TrainConfig, times: Sequence[float]) -> float | None:
    """The share of the clip to restart with, for training views at `times`; None where none has enough views."""
    for share in RESTART_WINDOWS:
        window = TimeWindow(config, times, share)
        if MIN_VIEWS <= sum(window.has(view, 0) for view in range(len(times))) < len(times):
            return share
    return None
