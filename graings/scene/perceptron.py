"""Multilayer perceptron: linear layers with ReLU between them, for many rows at once, in the compiled kernel.

Torch evaluates one layer at a time and writes every activation to memory; the kernel takes a block of rows through all
layers while it is in the cache.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from graings import kernel

# Of each thread: one may train while another renders.
_bfloat16 = ContextVar("bfloat16", default=False)


@contextmanager
def bfloat16_products(enabled: bool = True) -> Iterator[None]:
    """Inside the context `perceptron` rounds the factors of its products to bfloat16, in both passes, in this thread.

    Sums, biases and outputs stay float32. Without `kernel.has_bfloat16_products()`, `perceptron` raises `ValueError`.
    """
    token = _bfloat16.set(enabled)
    try:
        yield
    finally:
        _bfloat16.reset(token)


class GroupBias(NamedTuple):
    """A bias per group of rows, added to the first layer: row i gets `values[groups[i]]`. `groups` must ascend."""

    values: Float[Tensor, "group first"]
    groups: Int64[Tensor, " row"]


def perceptron(
    inputs: Float[Tensor, "row input"],
    weights: Sequence[Float[Tensor, "_ _"]],
    biases: Sequence[Float[Tensor, " _"]],
    *,
    shared: GroupBias | None = None,
) -> Float[Tensor, "row output"]:
    """W_n relu(... relu(W_1 x + s + b_1) ...) + b_n for each row x; weights are [out, in] as in torch.

    s is the row's bias of `shared`, if given. Differentiable once in all tensors. Values and gradients have the same
    bits for any number of CPU threads. Raises `ValueError` for a wrong shape, dtype, device or order of groups.
    """
    width, dtype = inputs.shape[-1], inputs.dtype
    if inputs.ndim != 2 or dtype not in (torch.float32, torch.float64):
        raise ValueError(f"inputs must be [row, input] in float32 or float64, got {tuple(inputs.shape)} in {dtype}")
    if not weights or len(weights) != len(biases):
        raise ValueError(f"every layer needs a weight and a bias, got {len(weights)} weights and {len(biases)} biases")
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        if weight.ndim != 2 or weight.shape[1] != width or bias.shape != weight.shape[:1]:
            raise ValueError(
                f"layer {layer} has {width} inputs: its weight must be [out, {width}] and its bias [out], "
                f"got {tuple(weight.shape)} and {tuple(bias.shape)}"
            )
        width = weight.shape[0]
    groups: Tensor | None = None
    tensors = [inputs, *weights, *biases]
    if shared is not None:
        groups = shared.groups
        if shared.values.ndim != 2 or shared.values.shape[1] != len(biases[0]) or groups.shape != inputs.shape[:1]:
            raise ValueError(
                f"shared values must be [group, {len(biases[0])}] with a group for each of {len(inputs)} rows, "
                f"got {tuple(shared.values.shape)} and {tuple(groups.shape)}"
            )
        tensors.append(shared.values)
    if any(t.dtype != dtype or t.device.type != "cpu" for t in tensors):
        raise ValueError(f"inputs, weights, biases and shared values must all be {dtype} on the CPU")
    bfloat16 = _bfloat16.get() and dtype == torch.float32
    values: Tensor = _Perceptron.apply(kernel.thread_count(), bfloat16, groups, *tensors)  # type: ignore[no-untyped-call]
    return values


def plain_perceptron(
    inputs: Float[Tensor, "row input"],
    weights: Sequence[Float[Tensor, "_ _"]],
    biases: Sequence[Float[Tensor, " _"]],
    *,
    shared: GroupBias | None = None,
) -> Float[Tensor, "row output"]:
    """The oracle of `perceptron`: the same layers, one after the other in torch."""
    values = functional.linear(inputs, weights[0], biases[0])
    if shared is not None:
        values = values + shared.values.index_select(0, shared.groups)
    for weight, bias in zip(weights[1:], biases[1:], strict=True):
        values = functional.linear(functional.relu(values), weight, bias)
    return values


def weights_and_biases(layers: Iterable[nn.Module]) -> tuple[list[Tensor], list[Tensor]]:
    """Weights and biases of the linear layers among `layers`, in order."""
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    return [layer.weight for layer in linear], [layer.bias for layer in linear]


class _Perceptron(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, threads: int, bfloat16: bool, groups: Tensor | None, *tensors: Tensor) -> Tensor:
        contiguous = [t.detach().contiguous() for t in tensors]
        inputs, weights, biases, shared = _unpacked(contiguous)
        groups = None if groups is None else groups.contiguous()
        output = inputs.new_empty(len(inputs), len(biases[-1]))
        hidden: Tensor | None = None
        if any(ctx.needs_input_grad):
            widths = [inputs.shape[1], *map(len, biases)]
            hidden = inputs.new_empty(kernel.call("hidden_size", widths, len(inputs), bfloat16))
            ctx.save_for_backward(hidden, groups, *contiguous)
            ctx.bfloat16, ctx.threads = bfloat16, threads
        kernel.call("network", inputs, weights, biases, shared, groups, output, hidden, bfloat16, threads)
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        hidden, groups, *tensors = ctx.saved_tensors
        inputs, weights, biases, shared = _unpacked(tensors)
        v_inputs = torch.empty_like(inputs) if ctx.needs_input_grad[3] else None
        v_shared = None if shared is None else torch.empty_like(shared)
        v_weights, v_biases = [torch.empty_like(w) for w in weights], [torch.empty_like(b) for b in biases]
        layers, gradients = (inputs, weights, biases, shared, groups), (v_inputs, v_weights, v_biases, v_shared)
        upstream = upstream.contiguous()
        kernel.call("network_gradient", *layers, hidden, upstream, *gradients, ctx.bfloat16, ctx.threads)
        return None, None, None, v_inputs, *v_weights, *v_biases, *([] if v_shared is None else [v_shared])


def _unpacked(tensors: Sequence[Tensor]) -> tuple[Tensor, list[Tensor], list[Tensor], Tensor | None]:
    """Inputs, weights, biases and shared values from [inputs, *weights, *biases] or [..., *biases, shared values]."""
    inputs, *rest = tensors
    layers = len(rest) // 2
    return inputs, rest[:layers], rest[layers : 2 * layers], rest[-1] if len(rest) % 2 else None
