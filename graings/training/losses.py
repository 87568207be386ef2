"""The loss terms on the model itself as pure functions, each with its equation; `graings.raster.photometric` is that
on the image.

Reductions are means over Gaussians (decision 10): a sum would change the balance with every
growth. Knows nothing of schedules or optimisers.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from graings.scene.deformation import Deformation


def temporal(
    now: Float[Tensor, "gaussian 3"], neighbour: Float[Tensor, "gaussian 3"], gap: float, mean_gap: float
) -> Tensor:
    """Mean squared change of the position offset between two neighbouring times, Eq. 16.

    `gap` is the time between them and `mean_gap` the capture's mean: an irregular pair counts by its speed.
    """
    return (now - neighbour).square().sum(-1).mean() * (mean_gap / gap)


def deformation(offsets: Deformation) -> Tensor:
    """Mean squared magnitude of all geometric offsets, Eq. 17; rotation as its distance from none."""
    return (
        offsets.position.square().sum(-1) + offsets.rotation.square().sum(-1) + offsets.log_scales.square().sum(-1)
    ).mean()


def residual(change: Float[Tensor, "gaussian 4"]) -> Tensor:
    """Mean squared appearance residual (Delta c, Delta o), Eq. 18."""
    return change.square().sum(-1).mean()
