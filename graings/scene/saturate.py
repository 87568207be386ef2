"""Saturate: tanh and sigmoid whose gradient does not die.

In single precision tanh is exactly 1 from 9.02 on and the sigmoid from about 17, and a derivative formed from such a
value is exactly 0: no loss could ever bring it back. Formed from the argument it stays positive, and Adam, which
knows no scale, moves it. Values are torch's own. Knows nothing of what the numbers mean.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


class _Saturating(torch.autograd.Function):
    """The derivative of a sigmoid stretched by `stretch` in both directions: stretch^2 E / (1 + E)^2."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, values: Tensor, stretch: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.stretch = stretch
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors
        tail = (ctx.stretch * x).abs_().neg_().exp_()
        return tail.div_((1.0 + tail).square_()).mul_(grad_outputs[0]).mul_(ctx.stretch**2), None, None


def tanh(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Hyperbolic tangent; its derivative is 4 E / (1 + E)^2 with E = exp(-2 |x|)."""
    result: Tensor = _Saturating.apply(x, torch.tanh(x.detach()), 2.0)  # type: ignore[no-untyped-call]
    return result


def sigmoid(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """1 / (1 + exp(-x)); its derivative is E / (1 + E)^2 with E = exp(-|x|)."""
    result: Tensor = _Saturating.apply(x, torch.sigmoid(x.detach()), 1.0)  # type: ignore[no-untyped-call]
    return result
