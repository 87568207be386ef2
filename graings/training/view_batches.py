"""ViewBatches: the training views of each step, at the resolution of that step."""

from __future__ import annotations

import math
from collections.abc import Sequence

from graings.capture.capture import Frame
from graings.training.curriculum.image_pyramid import ImagePyramid, PyramidLevel
from graings.training.curriculum.time_window import TimeWindow
from graings.training.view_sampler import ViewSampler


class ViewBatches:
    """Every view within the time window once per pass, in random order, at most `batch` of them per step.

    The views of a pass are divided evenly over its steps, so that no step is much smaller than the others.
    """

    def __init__(self, batch: int, window: TimeWindow, pyramid: ImagePyramid, sampler: ViewSampler) -> None:
        self.batch = batch
        self.window = window
        self.pyramid = pyramid
        self.sampler = sampler

    def level(self, iteration: int) -> PyramidLevel:
        """All views at the resolution of `iteration` (from 1)."""
        return self.pyramid.at(iteration)

    def next(self, iteration: int) -> list[Frame]:
        """The views of `iteration`; advances the pass."""
        while not (views := self.upcoming(iteration)):
            self.sampler.begin()  # the views left in this pass are outside the window
        while self.sampler.next() != views[-1]:
            pass  # views outside the window are skipped
        frames = self.level(iteration).frames
        return [frames[view] for view in views]

    def upcoming(self, iteration: int) -> list[int]:
        """Indices of the views of the next step, within the window of `iteration`; empty at the end of a pass."""
        remaining = [view for view in self.sampler.remaining.tolist() if self.window.has(view, iteration)]
        steps = math.ceil(len(remaining) / self.batch)
        return remaining[: math.ceil(len(remaining) / steps)] if steps else []

    def upcoming_frames(self, iteration: int) -> Sequence[Frame]:
        """The views of the step after `iteration` as far as they are known, to be decoded ahead."""
        frames = self.level(iteration + 1).frames
        return [frames[view] for view in self.upcoming(iteration)]
