"""TimeWindow: a curriculum in time, from a short part of the clip to all of it.

An object that moves farther than its own size during the static warm-up averages out, is not drawn, and gets no
gradient any more. Within a short window it stays in place.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from graings.config import TrainConfig

STAGES: Final = 20


class TimeWindow:
    """Which views are used at an iteration: those within a share of the clip around its middle, in the end all.

    `times` [V] are the views' times in [0, 1], `first` the initial share. The view nearest to the middle is
    always used.
    """

    def __init__(self, config: TrainConfig, times: Sequence[float], first: float) -> None:
        self.first = first
        self._from, self._until = config.scaled(config.warmup), config.scaled(config.time_window_until)
        self._apart = [2 * abs(time - 0.5) for time in times]
        self._nearest = min(self._apart)

    def share(self, iteration: int) -> float:
        """Share of the clip in use: the initial one until the warm-up ends, then growing linearly to 1."""
        if iteration <= self._from:
            return self.first
        progress = (iteration - self._from) / max(1, self._until - self._from)
        return min(1.0, self.first + (1.0 - self.first) * progress)

    def stage(self, iteration: int) -> int:
        """Which of `STAGES` of the window `iteration` belongs to: losses of different stages do not compare."""
        return int(self.share(iteration) * STAGES)

    def has(self, view: int, iteration: int) -> bool:
        """Whether `view` is used at `iteration`."""
        share = self.share(iteration)
        return share >= 1 or self._apart[view] <= max(share, self._nearest)
