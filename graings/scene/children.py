"""Children: inputs of the geometry networks per child Gaussian (Eq. 4), and composed geometry (Eq. 10).

Two operators of the compiled kernel, each with its oracle in plain torch: as a chain of small torch operations they
took longer than the networks between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from graings import kernel
from graings.scene.clip import clip
from graings.scene.scaffold import Scaffold

# The offset of a log-scale in time is clipped to plus or minus this (Eq. 10).
MAX_LOG_SCALE_OFFSET = 2.0

# Log standard deviations are clipped to this range: 1e-7 to 100 in normalised units, in which the scene is about 1
# across. Variances beyond it, and their inverses, would overflow float32.
LOG_SCALE_RANGE = (math.log(1e-7), math.log(100.0))


@dataclass(frozen=True, slots=True, eq=False)
class Children:
    """What N rendered children have from the scaffold alone, without any network."""

    anchors: Int64[Tensor, " gaussian"]  # index of the anchor of each, ascending
    inputs: Float[Tensor, "gaussian width"]  # offset epsilon, and a one-hot vector of the child's slot
    canonical_means: Float[Tensor, "gaussian 3"]  # x_can of Eq. 4, normalised units
    anchor_log_scales: Float[Tensor, "gaussian 3"]  # log s_a of the anchor


def gather(scaffold: Scaffold, children: Int64[Tensor, " gaussian"]) -> Children:
    """The children at the given flat slots (anchor * k + child) of `scaffold`, which must ascend; Eq. 4.

    Raises `ValueError` for slots out of order or out of range.
    """
    tensors = (scaffold.log_scales, scaffold.offsets, scaffold.anchors)
    inputs, means, log_scales = _Gather.apply(*tensors, children, kernel.thread_count())  # type: ignore[no-untyped-call]
    return Children(children // scaffold.slots, inputs, means, log_scales)


def plain_gather(scaffold: Scaffold, children: Int64[Tensor, " gaussian"]) -> Children:
    """The oracle of `gather`."""
    k = scaffold.slots
    owners = children // k
    offsets = scaffold.offsets.flatten(0, 1).index_select(0, children)
    slots = torch.eye(k, dtype=offsets.dtype).index_select(0, children % k)
    inputs = torch.cat([offsets, slots], dim=1)
    log_scales = scaffold.log_scales.index_select(0, owners)
    return Children(owners, inputs, scaffold.anchors.index_select(0, owners) + log_scales.exp() * offsets, log_scales)


# Means, quaternions and log-scales.
Geometry = tuple[Float[Tensor, "gaussian 3"], Float[Tensor, "gaussian 4"], Float[Tensor, "gaussian 3"]]


class ChildGeometry(NamedTuple):
    """N children at one time."""

    means: Float[Tensor, "gaussian 3"]
    quats: Float[Tensor, "gaussian 4"]
    log_scales: Float[Tensor, "gaussian 3"]
    position_offsets: Float[Tensor, "gaussian 3"] | None  # Delta x of Eq. 10, normalised units; None: static


def compose(
    canonical: Float[Tensor, "gaussian 7"],
    children: Children,
    deformation: Float[Tensor, "gaussian time 10"] | None,
    extent: float,
    *,
    projected_clip: bool,
) -> list[ChildGeometry]:
    """The rendered children at each time, Eq. 10; at one time without a `deformation`.

    `canonical` is the output of StaticMLP: quaternion minus the identity, log-scale minus the anchor's. `deformation`
    is that of DeformNet: offsets of position in units of `extent`, of rotation (minus the identity) and of log-scale;
    None for a static scene. Canonical quaternions are normalised; their product with Delta r is not, because the
    rasterizer normalises it.
    """
    inputs = (canonical, children.anchor_log_scales, children.canonical_means, deformation)
    outputs: tuple[Tensor, ...] = _Compose.apply(*inputs, extent, projected_clip, kernel.thread_count())  # type: ignore[no-untyped-call]
    if deformation is None:
        means, quats, log_scales = outputs
        return [ChildGeometry(means, quats, log_scales, None)]
    return [ChildGeometry(*outputs[first : first + 4]) for first in range(0, len(outputs), 4)]


def plain_compose(
    canonical: Float[Tensor, "gaussian 7"],
    children: Children,
    deformation: Float[Tensor, "gaussian time 10"] | None,
    extent: float,
    *,
    projected_clip: bool,
) -> list[ChildGeometry]:
    """The oracle of `compose`."""
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=canonical.dtype)
    quats = functional.normalize(canonical[:, :4] + identity, dim=-1, eps=1e-12)
    log_scales = children.anchor_log_scales + canonical[:, 4:]
    if deformation is None:
        log_scales = clip(log_scales, *LOG_SCALE_RANGE, projected=projected_clip)
        return [ChildGeometry(children.canonical_means, quats, log_scales, None)]
    result = []
    for offsets in deformation.unbind(1):
        position_offsets = offsets[:, :3] * extent
        change = clip(offsets[:, 7:], -MAX_LOG_SCALE_OFFSET, MAX_LOG_SCALE_OFFSET, projected=projected_clip)
        result.append(
            ChildGeometry(
                children.canonical_means + position_offsets,
                quaternion_product(quats, offsets[:, 3:7] + identity),
                clip(log_scales + change, *LOG_SCALE_RANGE, projected=projected_clip),
                position_offsets,
            )
        )
    return result


def quaternion_product(a: Float[Tensor, "gaussian 4"], b: Float[Tensor, "gaussian 4"]) -> Float[Tensor, "gaussian 4"]:
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
        tensors = [t.detach().contiguous() for t in (anchors, log_scales, offsets)]
        count = len(children)
        inputs = anchors.new_empty(count, 3 + offsets.shape[1])
        means, anchor_log_scales = anchors.new_empty(count, 3), anchors.new_empty(count, 3)
        kernel.call("gather", *tensors, children, inputs, means, anchor_log_scales, threads)
        ctx.save_for_backward(*tensors, children)
        ctx.threads = threads
        return inputs, means, anchor_log_scales

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_inputs: Tensor, v_means: Tensor, v_anchor_log_scales: Tensor) -> tuple[Tensor | None, ...]:
        anchors, log_scales, offsets, children = ctx.saved_tensors
        gradients: list[Tensor | None] = [torch.empty_like(t) for t in (log_scales, offsets)]
        upstream = [v.contiguous() for v in (v_inputs, v_means, v_anchor_log_scales)]
        kernel.call("gather_gradient", anchors, log_scales, offsets, children, *upstream, *gradients, ctx.threads)
        v_anchors = None
        if ctx.needs_input_grad[2]:
            v_anchors = torch.zeros_like(anchors).index_add_(0, children // offsets.shape[1], upstream[1])
        return (*gradients, v_anchors, None, None)


class _Compose(torch.autograd.Function):
    """Outputs are those of `ChildGeometry`, time after time."""

    @staticmethod
    def forward(
        ctx: Any,
        canonical: Tensor,
        anchor_log_scales: Tensor,
        canonical_means: Tensor,
        deformation: Tensor | None,
        extent: float,
        projected: bool,
        threads: int,
    ) -> tuple[Tensor, ...]:
        inputs = (canonical, anchor_log_scales, canonical_means, deformation)
        tensors = [None if t is None else t.detach().contiguous() for t in inputs]
        times = 1 if deformation is None else deformation.shape[1]
        widths = (3, 4, 3) if deformation is None else (3, 4, 3, 3)
        outputs = [canonical.new_empty(times, len(canonical), width) for width in widths]
        ctx.constants = (extent, MAX_LOG_SCALE_OFFSET, *LOG_SCALE_RANGE, projected)
        kernel.call("compose", *tensors, *ctx.constants, *outputs, *[None] * (4 - len(outputs)), threads)
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        ctx.threads = threads
        return tuple(output[time] for time in range(times) for output in outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        canonical, anchor_log_scales, canonical_means, deformation = ctx.saved_tensors
        gradients = [None if v is None else v.contiguous() for v in upstream]
        if deformation is None:
            of_outputs = [[gradient] for gradient in (*gradients, None)]
        else:
            of_outputs = [gradients[output::4] for output in range(4)]
        v_canonical, v_log_scales = torch.empty_like(canonical), torch.empty_like(anchor_log_scales)
        v_means = torch.empty_like(canonical_means)
        v_deformation = None if deformation is None else torch.empty_like(deformation)
        inputs = (canonical, anchor_log_scales, canonical_means, deformation)
        results = (v_canonical, v_log_scales, v_means, v_deformation)
        kernel.call("compose_gradient", *inputs, *ctx.constants, *of_outputs, *results, ctx.threads)
        return (*results, None, None, None)
