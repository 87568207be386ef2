"""Attempt: what of a run is trained as one, from the first anchors to the last step.

Most runs are one attempt. Knows nothing of why another one begins.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from graings.config import TrainConfig


@dataclass(frozen=True, slots=True)
class Attempt:
    """The iterations of a run after the `began` that an earlier attempt took.

    Its schedule is that of a run of so many, and its `time_window`, where it has one, goes before the configuration's.
    """

    began: int = 0
    time_window: float | None = None

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Attempt:
        """As the facts of a checkpoint say; older ones, which say nothing, belong to the first."""
        return cls(**facts.get("attempt", {}))

    def config(self, config: TrainConfig) -> TrainConfig:
        """That of the attempt, of a run that `config` describes. Raises `ValueError` where no iteration is left."""
        if self.began == 0:
            return config
        left = config.iterations - self.began
        if self.began < 0 or left < 1:
            raise ValueError(f"an attempt cannot begin after {self.began} of {config.iterations} iterations")
        return config.model_copy(update={"iterations": left, "time_window": self.time_window})
