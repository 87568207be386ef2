"""Timing: seconds per phase of a run, its rate, and the iterations after which it is evaluated."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from graings.config import TrainConfig
from graings.config.schedule import TRAINING_PHASES

# The rate shown to the user is the mean over about this many recent seconds.
RATE_WINDOW_S = 5.0


@dataclass(slots=True)
class Clock:
    """Seconds per phase, none counted twice.

    The wall clock beside them starts with the object and adds the `before_s` of earlier starts of the run: time that
    belongs to no phase shows as a difference. `train_cpu_s` is the CPU time of all threads while training, which
    hardly depends on other load of the machine.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    before_s: float = 0.0
    train_cpu_s: float = 0.0
    _started: float = field(default_factory=lambda: time.perf_counter())  # looked up now: tests replace the time

    def add(self, phase: str, seconds: float, cpu_s: float = 0.0) -> None:
        """Add `seconds` to a phase of training, or to load, evaluation, checkpoint or report.

        `cpu_s` is the CPU time of a phase of training.
        """
        self.seconds[phase] = self.seconds.get(phase, 0.0) + seconds
        self.train_cpu_s += cpu_s

    @contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        """A context whose time is added to `phase`, and its CPU time if that is a phase of training."""
        started, computed = time.perf_counter(), time.process_time()
        yield
        cpu_s = time.process_time() - computed if phase in TRAINING_PHASES else 0.0
        self.add(phase, time.perf_counter() - started, cpu_s)

    def train_s(self) -> float:
        """Seconds of training alone."""
        return sum(self.seconds.get(phase, 0.0) for phase in TRAINING_PHASES)

    def total_s(self) -> float:
        """Seconds of everything."""
        return sum(self.seconds.values())

    def wall_s(self) -> float:
        """Wall-clock seconds, interruptions left out."""
        return self.before_s + time.perf_counter() - self._started


class Rate:
    """Iterations per second over the last few seconds."""

    def __init__(self) -> None:
        self._recent: list[float] = []
        self._sum = 0.0

    def add(self, seconds: float) -> None:
        """Add a step that took `seconds`."""
        self._recent.append(seconds)
        self._sum += seconds
        while len(self._recent) > 1 and self._sum - self._recent[0] > RATE_WINDOW_S:
            self._sum -= self._recent.pop(0)

    def per_second(self) -> float:
        """Steps per second over the last few seconds."""
        return len(self._recent) / max(self._sum, 1e-9)


def evaluation_marks(config: TrainConfig, iterations: int) -> frozenset[int]:
    """Iterations below `iterations` after which the run is evaluated: geometrically spaced."""
    marks, mark = set(), float(config.evaluation.first)
    while mark < iterations:
        marks.add(round(mark))
        mark *= config.evaluation.factor
    return frozenset(marks)
