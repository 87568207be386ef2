"""Guard: whether a step may reach the optimiser, and whether training has diverged.

Bad gradients must be stopped before the optimiser: one spike of 1e3 times the usual size freezes its parameter for
20 000 steps of Adam. A step with a NaN or infinity is skipped and recorded, one with far too large gradients is
clipped and recorded; no value is ever repaired. The guard measures and counts, the trainer acts.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor

from graings.config import GuardConfig
from graings.training.guard.loss_trend import LossTrend

# One bad step can be due to a single view; three in a row mean that the parameters themselves are not finite.
MAX_CONSECUTIVE_SKIPS: Final = 3

# Skipped steps among the last MEMORY steps that count as divergence.
MAX_RECENT_SKIPS: Final = 10
MEMORY: Final = 1_000

# The usual norm of a group's gradient is the median over this many steps; it exists from MIN_NORMS steps on.
WINDOW: Final = 200
MIN_NORMS: Final = 20


class Gradient(NamedTuple):
    """One gradient tensor; those of one `group` are clipped together."""

    name: str
    group: str
    values: Tensor


@dataclass(frozen=True, slots=True)
class StepCheck:
    """Result of checking one step: what is not finite, if anything, and groups whose gradients are far too large.

    `limits` maps a group to (its norm, the norm it may have).
    """

    non_finite: str | None = None
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)


class Guard:
    """Checks steps and keeps the statistics that the next checks need.

    `skipped` and `clipped` count steps of the whole run, also those that a rollback undid; `rollbacks` are those since
    the run began or was restarted.
    """

    def __init__(self, config: GuardConfig) -> None:
        self.config = config
        self.skipped = 0
        self.clipped = 0
        self.rollbacks = 0
        self.consecutive = 0
        self.trend = LossTrend(config)
        self._recent: list[int] = []
        self._norms: dict[str, deque[float]] = {}
        self._last = ""

    def check_step(self, iteration: int, loss: Tensor, gradients: Sequence[Gradient]) -> StepCheck:
        """Check the step `iteration` from its mean loss and its gradients, before the optimiser is run."""
        norms = _norms(gradients)
        non_finite = None if bool(torch.isfinite(loss)) else "the loss"
        if non_finite is None:
            bad = (gradient.name for gradient, norm in zip(gradients, norms, strict=True) if not math.isfinite(norm))
            non_finite = next((f"the gradient of {name}" for name in bad), None)
        if non_finite is not None:
            self.skipped += 1
            self.consecutive += 1
            self._recent = [*(one for one in self._recent if one > iteration - MEMORY), iteration]
            self._last = non_finite
            return StepCheck(non_finite)
        self.consecutive = 0
        self.trend.add(float(loss))
        limits = {} if self.config.skip_only else self._limits(gradients, norms)
        self.clipped += bool(limits)
        return StepCheck(None, limits)

    def problem(self) -> str | None:
        """Why training has to roll back, or None."""
        if self.consecutive >= MAX_CONSECUTIVE_SKIPS:
            return f"{self._last} was not finite in {self.consecutive} steps in a row"
        if len(self._recent) >= MAX_RECENT_SKIPS:
            return f"{len(self._recent)} of the last {MEMORY} steps were not finite, the last because of {self._last}"
        return None if self.config.skip_only else self.trend.problem()

    @property
    def diverging(self) -> bool:
        """Whether the loss is far above its best, so that training may have to roll back."""
        return not self.config.skip_only and not self.trend.healthy

    @property
    def may_roll_back(self) -> bool:
        """Whether another return to a snapshot is allowed."""
        return not self.config.skip_only and self.rollbacks < self.config.rollbacks

    def rolled_back(self, before: Guard) -> None:
        """This guard was restored from a snapshot; take over the counts of the guard `before` the rollback."""
        self.skipped, self.clipped, self.rollbacks = before.skipped, before.clipped, before.rollbacks
        self.consecutive, self._recent = 0, []

    def restarted(self, before: Guard) -> None:
        """This guard watches a new scene of the run that the guard `before` watched; take over its counts."""
        self.skipped, self.clipped = before.skipped, before.clipped

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything the next check depends on: norms by group, and plain numbers."""
        tensors = {name: torch.tensor(list(norms), dtype=torch.float64) for name, norms in self._norms.items()}
        return tensors, {
            "skipped": self.skipped,
            "clipped": self.clipped,
            "rollbacks": self.rollbacks,
            "consecutive": self.consecutive,
            "recent": list(self._recent),
            "last": self._last,
            "trend": self.trend.state(),
        }

    def load(self, tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
        """Continue from what `state()` returned."""
        self._norms = {name: deque(norms.tolist(), maxlen=WINDOW) for name, norms in tensors.items()}
        self.skipped, self.clipped, self.rollbacks = facts["skipped"], facts["clipped"], facts["rollbacks"]
        self.consecutive, self._recent, self._last = facts["consecutive"], list(facts["recent"]), facts["last"]
        self.trend.load(facts["trend"])

    def _limits(self, gradients: Sequence[Gradient], norms: Sequence[float]) -> dict[str, tuple[float, float]]:
        squares: dict[str, list[float]] = {}
        for gradient, norm in zip(gradients, norms, strict=True):
            squares.setdefault(gradient.group, []).append(norm)
        limits: dict[str, tuple[float, float]] = {}
        for group, parts in squares.items():
            norm = math.hypot(*parts)
            if norm == 0:
                continue  # nothing was drawn: no evidence of the usual norm
            seen = self._norms.setdefault(group, deque(maxlen=WINDOW))
            if len(seen) >= MIN_NORMS:
                limit = self.config.clip * statistics.median(seen)
                if norm > limit:
                    limits[group] = (norm, limit)
                    norm = limit
            seen.append(norm)
        return limits


def first_not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Name of a tensor with a NaN or infinity, or None."""
    named = [Gradient(name, "", values) for name, values in tensors.items()]
    return next(
        (one.name for one, norm in zip(named, _norms(named), strict=True) if not math.isfinite(norm)),
        None,
    )


def _norms(gradients: Sequence[Gradient]) -> list[float]:
    """Euclidean norm of each tensor; it is not finite exactly where an entry is not."""
    if not gradients:
        return []
    found: list[float] = torch.stack(list(torch._foreach_norm([one.values for one in gradients], 2))).tolist()
    for index, norm in enumerate(found):
        if not math.isfinite(norm):
            # A float32 norm overflows from entries of 1e19 on, which are large and not yet wrong.
            found[index] = float(torch.linalg.vector_norm(gradients[index].values.double()))
    return found
