"""TimeWindow: a curriculum in time, from a short part of the clip to all of it.

What moves farther than its own size while the scene is taken for static averages out to nothing, and what is not drawn
does not come back. Within a short window it stays in place. Knows nothing of images, scenes or random streams.
"""

from __future__ import annotations

from collections.abc import Sequence

from graings.config import TrainConfig


class TimeWindow:
    """Which views take part at an iteration: those within a share of the clip around its middle, all in the end.

    `times` [V] are the views' times in [0, 1], `first` the share that it begins with. The view nearest to the middle
    always takes part.
    """

    def __init__(self, config: TrainConfig, times: Sequence[float], first: float) -> None:
        self.first = first
        self._from, self._until = config.scaled(config.warmup), config.scaled(config.time_window_until)
        self._apart = [2 * abs(time - 0.5) for time in times]
        self._nearest = min(self._apart)

    def share(self, iteration: int) -> float:
        """Share of the clip that takes part: as it begins until the warm-up ends, then widening evenly to 1."""
        if iteration <= self._from:
            return self.first
        progress = (iteration - self._from) / max(1, self._until - self._from)
        return min(1.0, self.first + (1.0 - self.first) * progress)

    def has(self, view: int, iteration: int) -> bool:
        """Whether `view` takes part at `iteration`."""
        share = self.share(iteration)
        return share >= 1 or self._apart[view] <= max(share, self._nearest)
