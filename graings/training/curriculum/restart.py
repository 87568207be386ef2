"""RestartState: which part of a run belongs to one training from the first anchors to the last step.

A run restarts once at most, where training has missed an object with large motion (`missing_motion`). One that begins
with tracks (`feature_tracks`) does not.
"""

from __future__ import annotations

from dataclasses import dataclass

from graings.config import TrainConfig


@dataclass(frozen=True, slots=True)
class RestartState:
    """`iterations_before` the restart were spent in addition to those of the configuration; 0 for a run without one.

    `time_window`, if not None, replaces the configuration's. With tracks (`tracked`) there is no static warm-up: in it
    what moves would become transparent.
    """

    iterations_before: int = 0
    time_window: float | None = None
    tracked: bool = False

    @classmethod
    def first(cls, tracked: bool) -> RestartState:
        """The start of a run."""
        return cls(0, 1.0, tracked) if tracked else cls()

    def config(self, config: TrainConfig) -> TrainConfig:
        """`config` with the time window of the restart, and its warm-up."""
        if self.time_window is None:
            return config
        warmup = 0 if self.tracked else config.warmup
        return config.model_copy(update={"time_window": self.time_window, "warmup": warmup})
