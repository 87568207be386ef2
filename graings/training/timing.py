"""Pace: what a run spends its seconds on, how fast it goes, and when it pauses to look at held-out views.

Knows nothing of what is done in those seconds.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from graings.config import TrainConfig
from graings.config.schedule import TRAINING_PHASES

# The rate shown to the user is the mean over about this many recent seconds.
RATE_WINDOW_S = 5.0


@dataclass(slots=True)
class Clock:
    """Seconds per phase; training, evaluation and saving never share a second.

    The wall clock beside them starts with the object, after the `before_s` of earlier sittings: what nobody booked
    shows as a difference. `train_cpu_s` is what all threads of the process computed while training, which a busy or
    halted machine does not change much; None where an earlier version trained a part of the run and did not look.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    before_s: float = 0.0
    train_cpu_s: float | None = 0.0
    _started: float = field(default_factory=time.perf_counter)

    def add(self, phase: str, seconds: float, cpu_s: float = 0.0) -> None:
        """Book `seconds` on a phase of training or on load, evaluation or checkpoint.

        `cpu_s` are the seconds of processors that a phase of training took.
        """
        self.seconds[phase] = self.seconds.get(phase, 0.0) + seconds
        if self.train_cpu_s is not None:
            self.train_cpu_s += cpu_s

    def train_s(self) -> float:
        """Seconds of training alone."""
        return sum(self.seconds.get(phase, 0.0) for phase in TRAINING_PHASES)

    def total_s(self) -> float:
        """Seconds of everything."""
        return sum(self.seconds.values())

    def wall_s(self) -> float:
        """Seconds on the wall, interruptions left out."""
        return self.before_s + time.perf_counter() - self._started


class Rate:
    """Iterations per second over the last few seconds."""

    def __init__(self) -> None:
        self._recent: list[float] = []
        self._sum = 0.0

    def add(self, seconds: float) -> None:
        """One more step, and how long it took."""
        self._recent.append(seconds)
        self._sum += seconds
        while len(self._recent) > 1 and self._sum - self._recent[0] > RATE_WINDOW_S:
            self._sum -= self._recent.pop(0)

    def per_second(self) -> float:
        """Steps per second lately."""
        return len(self._recent) / max(self._sum, 1e-9)


def evaluation_marks(config: TrainConfig, iterations: int) -> frozenset[int]:
    """Which of `iterations` are evaluated: geometrically spaced."""
    marks, mark = set(), float(config.evaluation.first)
    while mark < iterations:
        marks.add(round(mark))
        mark *= config.evaluation.factor
    return frozenset(marks)
