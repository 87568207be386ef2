"""Streams: named random streams, so that leaving one part out does not change the numbers of another.

Each name seeds its own generator. Knows nothing of what the numbers are used for.
"""

from __future__ import annotations

import torch
from torch import Tensor

from graings.seeds import named_seed


class Streams:
    """Generators by name, created on first use and saved whole."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._generators: dict[str, torch.Generator] = {}

    def __getitem__(self, name: str) -> torch.Generator:
        if name not in self._generators:
            generator = torch.Generator()
            generator.manual_seed(named_seed(self.seed, name))
            self._generators[name] = generator
        return self._generators[name]

    def state(self) -> dict[str, Tensor]:
        """State of every stream used so far."""
        return {name: generator.get_state() for name, generator in sorted(self._generators.items())}

    def load(self, state: dict[str, Tensor]) -> None:
        """Continue where `state` was taken."""
        for name, tensor in state.items():
            self[name].set_state(tensor)


class ViewSampler:
    """Training views without replacement: every view once, in a new random order each round."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        if count < 1:
            raise ValueError(f"count must be at least 1, got {count}")
        self.count = count
        self.generator = generator
        self.remaining = torch.empty(0, dtype=torch.int64)

    def begin(self) -> None:
        """Begin a new round, whatever is left of this one."""
        self.remaining = torch.randperm(self.count, generator=self.generator)

    def next(self) -> int:
        """Index of the next view."""
        if len(self.remaining) == 0:
            self.begin()
        index = int(self.remaining[0])
        self.remaining = self.remaining[1:]
        return index
