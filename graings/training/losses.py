"""The loss terms on the model itself as pure functions, each with its equation, and that on a picture's alpha;
`graings.raster.photometric` is that on its colours.

Reductions are means over Gaussians (decision 10), or over pixels: a sum would change the balance with every
growth. Knows nothing of schedules or optimisers.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from graings.scene.deformation import Deformation

# A strain well above this costs in proportion, so that joints may bend for the price of what they bend; one well below,
# with its square, so that what hardly moves is left alone.
SLIGHT_STRAIN: Final = 0.01

LEVEL: Final = 1 / 255  # of a picture file; a smaller difference in alpha may be the file's rounding


def temporal(
    now: Float[Tensor, "gaussian 3"], neighbour: Float[Tensor, "gaussian 3"], gap: float, mean_gap: float
) -> Tensor:
    """Mean squared change of the position offset between two neighbouring times, Eq. 16.

    `gap` is the time between them and `mean_gap` the capture's mean: an irregular pair is divided by its gap.
    """
    return mean_square(now - neighbour) * (mean_gap / gap)


def deformation(offsets: Deformation) -> Tensor:
    """Mean squared magnitude of all geometric offsets, Eq. 17; rotation as its distance from none."""
    return mean_square(offsets.offsets)


def residual(change: Float[Tensor, "gaussian 4"]) -> Tensor:
    """Mean squared appearance residual (Delta c, Delta o), Eq. 18."""
    return mean_square(change)


def alpha(drawn: Float[Tensor, "height width"], seen: Float[Tensor, "height width"]) -> Tensor:
    """Mean over pixels of the absolute difference between the opacity drawn and a picture's alpha, both in [0, 1].

    Below a `LEVEL` its square, so that the gradient fades there (Girshick's smooth L1, "Fast R-CNN", Eq. 3).

    Not in the paper: on one background, a hole and a thing of the background's colour look the same, and so do empty
    space and a veil of that colour.
    """
    return functional.smooth_l1_loss(drawn, seen, beta=LEVEL)


def rigidity(lengths: Float[Tensor, "instant pair"], weights: Float[Tensor, " pair"]) -> Tensor:
    """Mean strain of pairs of Gaussians: how far their `lengths` at several instants are from their mean, beside it.

    Zero where everything moves as rigid bodies do. Not in the paper: what one camera sees of an instant says nothing of
    depth along its rays, and neighbours do (the isometry of Luiten et al., "Dynamic 3D Gaussians", between the
    instants of a step instead of from one frame to the next). Lengths are positive.
    """
    mean = lengths.mean(0)
    strain = (lengths - mean) / mean.detach()
    cost = (strain.square() + SLIGHT_STRAIN**2).sqrt() - SLIGHT_STRAIN
    return (cost.mean(0) * weights).sum() / weights.sum().clamp_min(1.0)


def mean_square(rows: Float[Tensor, "row _"]) -> Tensor:
    """Mean over at least one row of its squared length."""
    total: Tensor = _SquaredLength.apply(rows)  # type: ignore[no-untyped-call]
    return total / len(rows)


class _SquaredLength(torch.autograd.Function):
    """Sum of squares; as square().sum() it goes through memory five times on its way back, and it is asked often."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.save_for_backward(values)
        return torch.linalg.vector_norm(values.detach()).square()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:
        (values,) = ctx.saved_tensors
        gradient: Tensor = values * (2 * upstream[0])
        return gradient
