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


class _Tanh(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.tanh(x)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return 4.0 * grad_outputs[0] * _hill(2.0 * x)


class _Sigmoid(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.sigmoid(x)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return grad_outputs[0] * _hill(x)


def tanh(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Hyperbolic tangent; its derivative is 4 E / (1 + E)^2 with E = exp(-2 |x|)."""
    result: Tensor = _Tanh.apply(x)  # type: ignore[no-untyped-call]
    return result


def sigmoid(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """1 / (1 + exp(-x)); its derivative is E / (1 + E)^2 with E = exp(-|x|)."""
    result: Tensor = _Sigmoid.apply(x)  # type: ignore[no-untyped-call]
    return result


def _hill(x: Tensor) -> Tensor:
    tail = x.abs().neg_().exp_()
    return tail / (1.0 + tail).square_()
