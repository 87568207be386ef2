"""Guard: no non-finite number reaches the optimiser.

A bad step is skipped and recorded, never repaired. Knows nothing of scenes or schedules.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from graings.errors import DivergedError

# One bad step can be a freak of a single view; three in a row mean the parameters themselves are lost.
MAX_CONSECUTIVE_SKIPS = 3


class Guard:
    """Checks the loss and all gradients of a step; counts what it had to skip."""

    def __init__(self) -> None:
        self.skipped = 0
        self.consecutive = 0

    def passes(self, loss: Tensor, parameters: Iterable[tuple[str, nn.Parameter]]) -> bool:
        """Whether the step may be taken. Raises `DivergedError` after three bad steps in a row."""
        culprit = None if bool(torch.isfinite(loss)) else "the loss"
        for name, parameter in parameters:
            if culprit is not None:
                break
            # The largest magnitude is non-finite exactly when some entry is (NaN wins every comparison).
            grad = parameter.grad
            if grad is not None and grad.numel() > 0 and not bool(torch.isfinite(grad.abs().amax())):
                culprit = f"the gradient of {name}"
        if culprit is None:
            self.consecutive = 0
            return True
        self.skipped += 1
        self.consecutive += 1
        if self.consecutive >= MAX_CONSECUTIVE_SKIPS:
            raise DivergedError(
                f"{culprit} was not finite in {self.consecutive} steps in a row. "
                "Resume from the last checkpoint with smaller rates (`--set rates....`)."
            )
        return False
