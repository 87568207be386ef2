"""Pyramid: the training views at the sizes at which training looks at them.

Knows nothing of images, models or losses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from graings.camera.sampling_rate import SamplingRate
from graings.capture.capture import Frame
from graings.config import TrainConfig
from graings.training.curriculum.resolution_schedule import downscale_factor, downscaled


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """All views at one size: so many `times` smaller along each side than the photographs."""

    times: int
    frames: tuple[Frame, ...]
    sampling: SamplingRate


class ImagePyramid:
    """`frames` at every size that the schedule of `config` asks for; their content lies within `extent`."""

    def __init__(self, config: TrainConfig, frames: Sequence[Frame], extent: float) -> None:
        self._config = config
        self._frames = tuple(frames)
        self._cameras = [frame.camera for frame in frames]
        self._extent = extent
        self._levels: dict[int, Level] = {}

    def at(self, iteration: int) -> Level:
        """What `iteration` (from 1) looks at."""
        times = downscale_factor(self._config, self._cameras, iteration)
        if times not in self._levels:
            frames = tuple(replace(frame, camera=downscaled(frame.camera, times)) for frame in self._frames)
            sampling = SamplingRate.of([frame.camera for frame in frames], self._extent)
            self._levels[times] = Level(times, frames, sampling)
        return self._levels[times]
