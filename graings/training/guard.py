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
        grads = [(name, p.grad) for name, p in parameters if p.grad is not None and p.grad.numel() > 0]
        culprit = None if bool(torch.isfinite(loss)) else "the loss"
        # The largest magnitude is non-finite exactly when some entry is (NaN wins every comparison).
        largest = torch._foreach_norm([grad for _, grad in grads], torch.inf) if grads else []
        if culprit is None and largest and not bool(torch.stack(list(largest)).isfinite().all()):
            bad = next(name for (name, _), size in zip(grads, largest, strict=True) if not size.isfinite())
            culprit = f"the gradient of {bad}"
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
