"""Snapshots: the last healthy states of a training, in memory, for rollbacks."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Final

from torch import Tensor

from graings.scene.scene import Scene

# The newest may have been taken when training was already diverging unnoticed; the one before it was not.
KEPT: Final = 2


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A copy of everything that the step after `iteration` depends on."""

    iteration: int
    scene: Scene
    tensors: dict[str, Tensor]
    facts: dict[str, Any]


class Snapshots:
    """The last two snapshots. One from which training diverged again is dropped for the one before it."""

    def __init__(self) -> None:
        self._kept: list[Snapshot] = []
        self._tried = False

    def __len__(self) -> int:
        return len(self._kept)

    def take(self, iteration: int, scene: Scene, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
        """Keep a copy of these; gradients must have been cleared."""
        copied = {name: values.clone() for name, values in tensors.items()}
        self._kept = [
            *self._kept[-(KEPT - 1) :],
            Snapshot(iteration, copy.deepcopy(scene), copied, copy.deepcopy(facts)),
        ]
        self._tried = False

    def back(self) -> Snapshot:
        """The snapshot to roll back to. Raises `ValueError` when none was taken."""
        if not self._kept:
            raise ValueError("no snapshot was taken")
        if self._tried and len(self._kept) > 1:
            self._kept.pop()
        self._tried = True
        return self._kept[-1]

    @property
    def newest(self) -> Snapshot:
        """The newest snapshot. Raises `ValueError` when there is none."""
        if not self._kept:
            raise ValueError("no snapshot was taken")
        return self._kept[-1]
