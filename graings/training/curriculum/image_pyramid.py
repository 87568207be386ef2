"""ImagePyramid: the training views at every resolution of the schedule."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from graings.camera.sampling_rate import SamplingRate
from graings.capture.capture import Frame
from graings.config import TrainConfig
from graings.training.curriculum.resolution_schedule import downscale_factor, downscaled


@dataclass(frozen=True, slots=True, eq=False)
class PyramidLevel:
    """All views at one resolution: `factor` times smaller along each side than the images."""

    factor: int
    frames: tuple[Frame, ...]
    sampling: SamplingRate


class ImagePyramid:
    """`frames` at the resolutions of `config`'s schedule; `extent` is the radius of the content, normalised units."""

    def __init__(self, config: TrainConfig, frames: Sequence[Frame], extent: float) -> None:
        self._config = config
        self._frames = tuple(frames)
        self._cameras = [frame.camera for frame in frames]
        self._extent = extent
        self._levels: dict[int, PyramidLevel] = {}

    def at(self, iteration: int) -> PyramidLevel:
        """The level of `iteration` (from 1)."""
        factor = downscale_factor(self._config, self._cameras, iteration)
        if factor not in self._levels:
            frames = tuple(replace(frame, camera=downscaled(frame.camera, factor)) for frame in self._frames)
            sampling = SamplingRate.of([frame.camera for frame in frames], self._extent)
            self._levels[factor] = PyramidLevel(factor, frames, sampling)
        return self._levels[factor]
