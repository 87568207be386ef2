"""RestartState: what of a run is trained as one, from the first anchors to the last step.

Most runs are one attempt. Knows nothing of why another one begins.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from graings.config import TrainConfig


@dataclass(frozen=True, slots=True)
class RestartState:
    """All iterations that the configuration asks for, after the `iterations_before` that an earlier attempt took.

    Its `time_window`, where it has one, goes before the configuration's.
    """

    iterations_before: int = 0
    time_window: float | None = None

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> RestartState:
        """As the facts of a checkpoint say; older ones, which say nothing, belong to the first."""
        return cls(**facts.get("attempt", {}))

    def config(self, config: TrainConfig) -> TrainConfig:
        """`config` as the attempt follows it."""
        return config if self.time_window is None else config.model_copy(update={"time_window": self.time_window})
