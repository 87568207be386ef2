"""Trend: the running mean of the loss against the best it has been.

Says when a run that still has finite numbers has come apart. Knows nothing of what the loss is made of.
"""

from __future__ import annotations

from typing import Any, Final

from graings.config import GuardConfig

# Weight of the newest loss: single views differ by factors, fifty of them hardly do.
DECAY: Final = 0.02

# So many losses are no mean yet.
WARM_UP_STEPS: Final = 10

# A loss this small may double without anybody seeing it.
MARGIN: Final = 0.02

# New anchors need a moment to find their place: this many steps after a growth do not count. The schedule
# grows every 50 or 100 steps, so a longer pause would switch the detector off for most of a run.
GROWTH_PAUSE: Final = 25


class LossTrend:
    """Mean and best mean of the losses so far, and for how many steps in a row the mean has been far above."""

    def __init__(self, config: GuardConfig) -> None:
        self._config = config
        self.mean: float | None = None
        self.best = 0.0
        self.above = 0
        self._count = 0
        self._settling = 0

    def add(self, loss: float) -> None:
        """One more finite loss."""
        if self.mean is None:
            self.mean = self.best = loss
        # A plain mean at first: the very first losses would otherwise weigh on it for a hundred steps.
        self._count += 1
        self.mean += max(DECAY, 1.0 / self._count) * (loss - self.mean)
        # An easy view at the start would make all others look like a relapse.
        self.best = self.mean if self._count <= WARM_UP_STEPS else min(self.best, self.mean)
        if self.mean <= self._limit():
            self.above = 0
        elif self._settling == 0:
            self.above += 1
        self._settling = max(0, self._settling - 1)

    def grown(self) -> None:
        """The scene has just been given new anchors."""
        self._settling = GROWTH_PAUSE

    def begin(self) -> None:
        """From here on losses are of something else: those so far say nothing about them."""
        self.mean, self.best, self.above, self._count = None, 0.0, 0, 0

    @property
    def healthy(self) -> bool:
        """Whether the mean is near the best, so that the moment is worth coming back to."""
        return self.mean is None or self.mean <= self._limit()

    def problem(self) -> str | None:
        """Why the run has come apart, or None."""
        if self.above < self._config.patience:
            return None
        return f"the mean loss was {self.mean:.3g} for {self.above} steps, after it had been {self.best:.3g}"

    def state(self) -> dict[str, Any]:
        """Plain numbers to go on from."""
        return {
            "mean": self.mean,
            "best": self.best,
            "above": self.above,
            "count": self._count,
            "settling": self._settling,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from what `state()` gave."""
        self.mean, self.best, self.above = state["mean"], state["best"], state["above"]
        self._count, self._settling = state["count"], state["settling"]

    def _limit(self) -> float:
        return max(self._config.excess * self.best, self.best + MARGIN)
