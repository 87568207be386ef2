"""The drawn children: what the networks read of them, and the geometry that the networks' answers make.

Two operators of the compiled kernel, each with its oracle in plain torch: as a chain of small torch operations they
took longer than the networks between them. Knows nothing of networks, cameras, colours or opacity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from graings import kernel
from graings.scene.clip import clip
from graings.scene.scaffold import Scaffold

# Bound on the change of a log-scale in time (Eq. 10).
LOG_SCALE_BOUND = 2.0

# Log standard deviations are kept in this range of normalised units: a factor 1e7 below and 100 above the
# scene. Outside, exp and its square would leave float32 (numerics, 2.8).
LOG_SCALE_RANGE = (-16.118095650958319, 4.605170185988092)


@dataclass(frozen=True, slots=True, eq=False)
class Children:
    """What is known of N drawn children before any network has spoken."""

    anchors: Int64[Tensor, " drawn"]  # the anchor of each, ascending
    inputs: Float[Tensor, "drawn width"]  # offset, and a one at the child's slot
    centres: Float[Tensor, "drawn 3"]  # x_can, Eq. 4
    log_scales: Float[Tensor, "drawn 3"]  # log s_a of the anchor


def gather(scaffold: Scaffold, children: Int64[Tensor, " drawn"]) -> Children:
    """The drawn children of `scaffold`: flat slots (anchor * k + child) in ascending order.

    Raises `ValueError` for any other order or slot.
    """
    tensors = (scaffold.log_scales, scaffold.offsets, scaffold.anchors)
    inputs, centres, log_scales = _Gather.apply(*tensors, children, kernel.thread_count())  # type: ignore[no-untyped-call]
    return Children(children // scaffold.slots, inputs, centres, log_scales)


def plain_gather(scaffold: Scaffold, children: Int64[Tensor, " drawn"]) -> Children:
    """The oracle of `gather`."""
    k = scaffold.slots
    owners = children // k
    offsets = scaffold.offsets.flatten(0, 1).index_select(0, children)
    slots = torch.eye(k, dtype=offsets.dtype).index_select(0, children % k)
    inputs = torch.cat([offsets, slots], dim=1)
    log_scales = scaffold.log_scales.index_select(0, owners)
    return Children(owners, inputs, scaffold.anchors.index_select(0, owners) + log_scales.exp() * offsets, log_scales)


Geometry = tuple[Float[Tensor, "drawn 3"], Float[Tensor, "drawn 4"], Float[Tensor, "drawn 3"]]


def compose(
    canonical: Float[Tensor, "drawn 7"],
    children: Children,
    moved: Float[Tensor, "drawn 10"] | None,
    extent: float,
    *,
    projected_clip: bool,
) -> Geometry:
    """(means, quaternions, log-scales) of the drawn children, Eq. 5 and 10.

    `canonical` is StaticMLP's answer: quaternion less the identity, log-scale less the anchor's. `moved` is
    DeformNet's: position in units of `extent`, rotation less the identity, log-scale; None while nothing moves.
    Quaternions are not normalised after they were turned (the rasterizer does that once).
    """
    values: Geometry = _Compose.apply(  # type: ignore[no-untyped-call]
        canonical, children.log_scales, children.centres, moved, extent, projected_clip, kernel.thread_count()
    )
    return values


def plain_compose(
    canonical: Float[Tensor, "drawn 7"],
    children: Children,
    moved: Float[Tensor, "drawn 10"] | None,
    extent: float,
    *,
    projected_clip: bool,
) -> Geometry:
    """The oracle of `compose`."""
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=canonical.dtype)
    quats = functional.normalize(canonical[:, :4] + identity, dim=-1, eps=1e-12)
    log_scales = children.log_scales + canonical[:, 4:]
    means = children.centres
    if moved is not None:
        means = means + moved[:, :3] * extent
        quats = quaternion_product(quats, moved[:, 3:7] + identity)
        change = clip(moved[:, 7:], -LOG_SCALE_BOUND, LOG_SCALE_BOUND, projected=projected_clip)
        log_scales = log_scales + change
    return means, quats, clip(log_scales, *LOG_SCALE_RANGE, projected=projected_clip)


def quaternion_product(a: Float[Tensor, "drawn 4"], b: Float[Tensor, "drawn 4"]) -> Float[Tensor, "drawn 4"]:
    """Hamilton product of (w, x, y, z) quaternions, not normalised."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, log_scales: Tensor, offsets: Tensor, anchors: Tensor, children: Tensor, threads: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        ready = [t.detach().contiguous() for t in (anchors, log_scales, offsets)]
        drawn = len(children)
        inputs = anchors.new_empty(drawn, 3 + offsets.shape[1])
        centres, bases = anchors.new_empty(drawn, 3), anchors.new_empty(drawn, 3)
        kernel.kernel().gather(*ready, children, inputs, centres, bases, threads)
        ctx.save_for_backward(*ready, children)
        ctx.threads = threads
        return inputs, centres, bases

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_inputs: Tensor, v_centres: Tensor, v_bases: Tensor) -> tuple[Tensor | None, ...]:
        anchors, log_scales, offsets, children = ctx.saved_tensors
        gradients = [torch.empty_like(t) for t in (log_scales, offsets)]
        upstream = [v.contiguous() for v in (v_inputs, v_centres, v_bases)]
        kernel.kernel().gather_gradient(anchors, log_scales, offsets, children, *upstream, *gradients, ctx.threads)
        return (*gradients, None, None, None)


class _Compose(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        canonical: Tensor,
        bases: Tensor,
        centres: Tensor,
        moved: Tensor | None,
        extent: float,
        projected: bool,
        threads: int,
    ) -> Geometry:
        ready = [None if t is None else t.detach().contiguous() for t in (canonical, bases, centres, moved)]
        means, quats = torch.empty_like(centres), centres.new_empty(len(centres), 4)
        log_scales = torch.empty_like(centres)
        ctx.constants = (extent, LOG_SCALE_BOUND, *LOG_SCALE_RANGE, projected)
        kernel.kernel().compose(*ready, *ctx.constants, means, quats, log_scales, threads)
        ctx.save_for_backward(*ready)
        ctx.threads = threads
        return means, quats, log_scales

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_means: Tensor, v_quats: Tensor, v_log_scales: Tensor) -> tuple[Tensor | None, ...]:
        canonical, bases, centres, moved = ctx.saved_tensors
        v_canonical = torch.empty_like(canonical)
        v_moved = None if moved is None else torch.empty_like(moved)
        upstream = [v.contiguous() for v in (v_means, v_quats, v_log_scales)]
        kernel.kernel().compose_gradient(
            canonical, bases, centres, moved, *ctx.constants, *upstream, v_canonical, v_moved, ctx.threads
        )
        return v_canonical, v_canonical[:, 4:], v_means, v_moved, None, None, None
