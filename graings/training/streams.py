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
    """Training views in passes: every view once, the hard ones twice, in a new random order each time.

    Hard is the share `hard` of the views seen so far whose error was largest when they were last seen.
    """

    def __init__(self, count: int, generator: torch.Generator, hard: float = 0.0) -> None:
        if count < 1:
            raise ValueError(f"count must be at least 1, got {count}")
        self.count = count
        self.generator = generator
        self.hard = hard
        self.remaining = torch.empty(0, dtype=torch.int64)
        self.errors = torch.zeros(count)  # 0: not seen yet, or nothing to learn from

    def next(self) -> int:
        """Index of the next view."""
        if len(self.remaining) == 0:
            order = torch.argsort(self.errors, descending=True, stable=True)
            hard = order[: int(self.hard * self.errors.count_nonzero())]
            views = torch.cat([torch.arange(self.count), hard])
            self.remaining = views[torch.randperm(len(views), generator=self.generator)]
        index = int(self.remaining[0])
        self.remaining = self.remaining[1:]
        return index

    def observe(self, view: int, error: float) -> None:
        """Note how far `view` is from its image: any measure, the same for all views."""
        self.errors[view] = error
