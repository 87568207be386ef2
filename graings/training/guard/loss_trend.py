"""LossTrend: the running mean of the loss compared with its best value so far.

It detects divergence while all numbers are still finite.
"""

from __future__ import annotations

from typing import Any, Final

from graings.config import GuardConfig

# Weight of the newest loss in the running mean: losses of single views differ by factors, means of fifty hardly do.
DECAY: Final = 0.02

# Until so many losses the best value follows the mean: an easy first view would make all others look diverged.
WARM_UP_STEPS: Final = 10

# A loss below this may double without a visible change.
MARGIN: Final = 0.02

# New anchors raise the loss for some steps: this many after a growth do not count. The schedule grows every 50 or
# 100 steps, so a longer pause would switch the detector off for most of a run.
GROWTH_PAUSE: Final = 25


class LossTrend:
    """Running mean of the losses, its best value, and for how many steps in a row it has been far above that."""

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
        # A plain mean at first: the first losses would otherwise dominate it for a hundred steps.
        self._count += 1
        self.mean += max(DECAY, 1.0 / self._count) * (loss - self.mean)
        self.best = self.mean if self._count <= WARM_UP_STEPS else min(self.best, self.mean)
        if self.mean <= self._limit():
            self.above = 0
        elif self._settling == 0:
            self.above += 1
        self._settling = max(0, self._settling - 1)

    def grown(self) -> None:
        """Anchors were just added."""
        self._settling = GROWTH_PAUSE

    def begin(self) -> None:
        """Start again: losses from here on (of another resolution) do not compare with those so far."""
        self.mean, self.best, self.above, self._count = None, 0.0, 0, 0

    @property
    def healthy(self) -> bool:
        """Whether the mean is near the best, so that the scene is worth a snapshot."""
        return self.mean is None or self.mean <= self._limit()

    def problem(self) -> str | None:
        """Why the run counts as diverged, or None."""
        if self.above < self._config.patience:
            return None
        return f"the mean loss was {self.mean:.3g} for {self.above} steps, after it had been {self.best:.3g}"

    def state(self) -> dict[str, Any]:
        """Plain numbers to continue from."""
        return {
            "mean": self.mean,
            "best": self.best,
            "above": self.above,
            "count": self._count,
            "settling": self._settling,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from what `state()` returned."""
        self.mean, self.best, self.above = state["mean"], state["best"], state["above"]
        self._count, self._settling = state["count"], state["settling"]

    def _limit(self) -> float:
        return max(self._config.excess * self.best, self.best + MARGIN)
