"""Loss terms as pure functions, each with its equation: those on the model itself, and that on alpha.

`graings.raster.photometric` is the term on colours. Reductions are means over Gaussians or pixels: with sums the
balance of the terms would change with every growth.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from graings.scene.deformation import Deformation

# The cost of a strain is linear well above this, so that joints may bend, and quadratic well below.
SLIGHT_STRAIN: Final = 0.01

LEVEL: Final = 1 / 255  # of an 8-bit image; a smaller difference in alpha may be rounding


def temporal(
    now: Float[Tensor, "gaussian 3"], neighbour: Float[Tensor, "gaussian 3"], gap: float, mean_gap: float
) -> Tensor:
    """Mean squared change of the position offset between two neighbouring times, Eq. 16.

    `gap` is the time between them and `mean_gap` the capture's mean: an irregular pair is divided by its gap.
    """
    return mean_square(now - neighbour) * (mean_gap / gap)


def deformation(offsets: Deformation) -> Tensor:
    """Mean over times and Gaussians of the squared size of all offsets, Eq. 17; rotation as its distance from none."""
    return mean_square(offsets.outputs.flatten(0, 1), offsets.units)


def residual(change: Float[Tensor, "gaussian 4"]) -> Tensor:
    """Mean squared appearance residual (Delta c, Delta o), Eq. 18."""
    return mean_square(change)


def alpha(
    drawn: Float[Tensor, "height width"],
    seen: Float[Tensor, "height width"],
    valid: Bool[Tensor, "height width"] | None = None,
) -> Tensor:
    """Mean over pixels, or the `valid` ones, of the absolute difference of rendered and image alpha in [0, 1].

    Below a `LEVEL` it is quadratic (Girshick's smooth L1, "Fast R-CNN", Eq. 3).

    Not in the paper: on one background, a hole and an object of the background colour look the same, and so do empty
    space and semi-transparent Gaussians of that colour.
    """
    if valid is None:
        return functional.smooth_l1_loss(drawn, seen, beta=LEVEL)
    total = functional.smooth_l1_loss(drawn[valid], seen[valid], beta=LEVEL, reduction="sum")
    return total / valid.sum().clamp_min(1)


def rigidity(lengths: Float[Tensor, "instant pair"], weights: Float[Tensor, " pair"]) -> Tensor:
    """Mean strain of pairs of Gaussians: deviation of their `lengths` at several times from the mean, relative to it.

    Zero for rigid motion. Not in the paper: one camera per time leaves the depth along its rays undetermined, and
    neighbours constrain it (the isometry loss of Luiten et al., "Dynamic 3D Gaussians", between the times of a step
    instead of consecutive frames). Lengths are positive.
    """
    mean = lengths.mean(0)
    strain = (lengths - mean) / mean.detach()
    cost = (strain.square() + SLIGHT_STRAIN**2).sqrt() - SLIGHT_STRAIN
    return (cost.mean(0) * weights).sum() / weights.sum().clamp_min(1.0)


def mean_square(rows: Float[Tensor, "row width"], units: Float[Tensor, " width"] | None = None) -> Tensor:
    """Mean over at least one row of its squared length; with `units` of each row's product with them."""
    total: Tensor = _SquaredLength.apply(rows, units)  # type: ignore[no-untyped-call]
    return total / len(rows)


class _SquaredLength(torch.autograd.Function):
    """Sum of squares. The backward pass of square().sum() goes through memory five times, this one once."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, units: Tensor | None) -> Tensor:
        ctx.save_for_backward(rows, units)
        return torch.linalg.vector_norm(rows.detach() if units is None else rows.detach() * units).square()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        rows, units = ctx.saved_tensors
        return rows * (2 * upstream[0] if units is None else units.square() * (2 * upstream[0])), None
