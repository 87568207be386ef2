"""ViewSampler: the order in which training looks at its views."""

from __future__ import annotations

import torch


class ViewSampler:
    """Training views without replacement: every view once per pass, in a new random order each pass."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        if count < 1:
            raise ValueError(f"count must be at least 1, got {count}")
        self.count = count
        self.generator = generator
        self.remaining = torch.empty(0, dtype=torch.int64)

    def begin(self) -> None:
        """Begin a new pass, whether or not this one is complete."""
        self.remaining = torch.randperm(self.count, generator=self.generator)

    def next(self) -> int:
        """Index of the next view."""
        if len(self.remaining) == 0:
            self.begin()
        index = int(self.remaining[0])
        self.remaining = self.remaining[1:]
        return index
