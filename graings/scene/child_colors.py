"""Colours of the drawn children from the outputs of their networks, Eq. 11 to 13.

An operator of the compiled kernel, with its oracle in plain torch: as a chain of torch operations they took as long as
the rasterizer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from graings import kernel
from graings.scene.activations import sigmoid, tanh
from graings.scene.clip import clip


class ChildColors(NamedTuple):
    """What N drawn children show at one time from one direction."""

    colors: Float[Tensor, "gaussian 3"]  # c(t) of Eq. 13
    residual: Float[Tensor, "gaussian 4"] | None  # (Delta c, Delta o) of Eq. 12


def child_colors(
    canonical: Float[Tensor, "slot 3"],
    residual: Float[Tensor, "slot 4"] | None,
    children: Int64[Tensor, " gaussian"],
    bound: float,
    *,
    projected_clip: bool,
) -> ChildColors:
    """Colours of the slots `children`, which must ascend: sigmoid(canonical) + `bound` tanh(residual) within [0, 1].

    `canonical` and `residual` are outputs of the networks for every slot; None is no residual. Raises `ValueError` for
    slots out of order or out of range.
    """
    constants = (children, bound, projected_clip, kernel.thread_count())
    if residual is None:
        return ChildColors(_ChildColors.apply(canonical, None, *constants), None)  # type: ignore[no-untyped-call]
    return ChildColors(*_ChildColors.apply(canonical, residual, *constants))  # type: ignore[no-untyped-call]


def plain_child_colors(
    canonical: Float[Tensor, "slot 3"],
    residual: Float[Tensor, "slot 4"] | None,
    children: Int64[Tensor, " gaussian"],
    bound: float,
    *,
    projected_clip: bool,
) -> ChildColors:
    """The oracle of `child_colors`."""
    colors = sigmoid(canonical.index_select(0, children))
    if residual is None:
        return ChildColors(colors, None)
    change = bound * tanh(residual.index_select(0, children))
    return ChildColors(clip(colors + change[:, :3], 0.0, 1.0, projected=projected_clip), change)


class _ChildColors(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        canonical: Tensor,
        residual: Tensor | None,
        children: Tensor,
        bound: float,
        projected: bool,
        threads: int,
    ) -> Tensor | tuple[Tensor, Tensor]:
        canonical = canonical.detach().contiguous()
        residual = None if residual is None else residual.detach().contiguous()
        total = canonical.new_empty(len(children), 3)
        change = None if residual is None else canonical.new_empty(len(children), 4)
        colors = None if residual is None else torch.empty_like(total)
        kernel.call("child_colors", canonical, residual, children, bound, projected, change, total, colors, threads)
        ctx.save_for_backward(canonical, residual, children, total)
        ctx.set_materialize_grads(False)
        ctx.constants = (bound, projected, threads)
        return total if colors is None or change is None else (colors, change)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor | None, v_change: Tensor | None = None) -> tuple[Tensor | None, ...]:
        canonical, residual, children, total = ctx.saved_tensors
        bound, projected, threads = ctx.constants
        upstream = [None if v is None else v.contiguous() for v in (v_colors, v_change)]
        results = [None if t is None else torch.empty_like(t) for t in (canonical, residual)]
        inputs = (canonical, residual, children, bound, projected, total)
        kernel.call("child_colors_gradient", *inputs, *upstream, *results, threads)
        return (*results, None, None, None, None)
