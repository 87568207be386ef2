"""Clip with a projected gradient, for the log-scales of Eq. 10 and the colours of Eq. 13.

The forward value is the plain clip. The plain derivative is zero outside the bounds, so a value that has left them
never returns. The projected derivative also passes a gradient outside where the descent step points back inside: this
is gradient descent projected on the box.
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
        outward = ((x > ctx.high) & (grad < 0)) | ((x < ctx.low) & (grad > 0))
        return grad.masked_fill(outward, 0.0), None, None


def clip(x: Tensor, low: float, high: float, *, projected: bool) -> Tensor:
    """`x` limited to [low, high]; with `projected` the gradient is that of the module docstring, else torch's."""
    if projected:
        result: Tensor = _ProjectedClip.apply(x, low, high)  # type: ignore[no-untyped-call]
        return result
    return x.clamp(low, high)
