"""Clip with a projected gradient.

The forward value is the plain clip. The plain derivative is zero outside the bounds, so a value that has
left can never be pulled back by the image. The projected derivative passes a gradient where the value is
inside, and outside where the descent step points back in: gradient descent projected on the box.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _ProjectedClip(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, low: float, high: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.low, ctx.high = low, high
        return x.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors
        (grad,) = grad_outputs
        blocked = ((x > ctx.high) & (grad < 0)) | ((x < ctx.low) & (grad > 0))
        return grad.masked_fill(blocked, 0.0), None, None


def clip(x: Tensor, low: float, high: float, *, projected: bool) -> Tensor:
    """`x` limited to [low, high]; `projected` chooses the gradient (see the module docstring)."""
    if projected:
        result: Tensor = _ProjectedClip.apply(x, low, high)  # type: ignore[no-untyped-call]
        return result
    return x.clamp(low, high)
