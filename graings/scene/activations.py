"""Activations: tanh and sigmoid whose derivatives do not vanish where their values saturate.

In float32 tanh is exactly 1 from 9.02 on and the sigmoid from about 17. A derivative computed from such a value is
exactly 0, and no loss could ever change it again. Computed from the argument it stays positive, and Adam, whose steps
do not depend on the size of gradients, leaves the saturation. The compiled kernel computes values in float64 and rounds
them: they have the same bits wherever a number stands in its tensor.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from graings import kernel

_SIGMOID, _TANH = 0, 1  # as in the kernel


class _Activation(torch.autograd.Function):
    """`values` of a sigmoid whose input and output are scaled by `stretch`: the derivative is stretch^2 E / (1 + E)^2.

    E = exp(-stretch |x|).
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, values: Tensor, stretch: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.stretch = stretch
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors
        exponential = (ctx.stretch * x).abs_().neg_().exp_()
        derivative = exponential.div_((1.0 + exponential).square_())
        return derivative.mul_(grad_outputs[0]).mul_(ctx.stretch**2), None, None


def tanh(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Hyperbolic tangent; its derivative is 4 E / (1 + E)^2 with E = exp(-2 |x|)."""
    result: Tensor = _Activation.apply(x, _values(x, _TANH), 2.0)  # type: ignore[no-untyped-call]
    return result


def sigmoid(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """1 / (1 + exp(-x)); its derivative is E / (1 + E)^2 with E = exp(-|x|)."""
    result: Tensor = _Activation.apply(x, _values(x, _SIGMOID), 1.0)  # type: ignore[no-untyped-call]
    return result


def _values(x: Tensor, function: int) -> Tensor:
    numbers = x.detach().contiguous()
    values = torch.empty_like(numbers)
    kernel.call("activate", function, numbers, values, kernel.thread_count())
    return values
