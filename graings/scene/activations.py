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
    @staticmethod
    def forward(ctx: Any, x: Tensor, function: int, threads: int) -> Tensor:
        x = x.detach().contiguous()
        values = torch.empty_like(x)
        kernel.call("activate", function, x, values, threads)
        ctx.save_for_backward(x)
        ctx.function, ctx.threads = function, threads
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors
        gradient = torch.empty_like(x)
        kernel.call("activate_gradient", ctx.function, x, upstream[0].contiguous(), gradient, ctx.threads)
        return gradient, None, None


def tanh(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Hyperbolic tangent; its derivative is 4 E / (1 + E)^2 with E = exp(-2 |x|)."""
    result: Tensor = _Activation.apply(x, _TANH, kernel.thread_count())  # type: ignore[no-untyped-call]
    return result


def sigmoid(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """1 / (1 + exp(-x)); its derivative is E / (1 + E)^2 with E = exp(-|x|)."""
    result: Tensor = _Activation.apply(x, _SIGMOID, kernel.thread_count())  # type: ignore[no-untyped-call]
    return result
