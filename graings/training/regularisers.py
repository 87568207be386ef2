"""Regularisers: the terms of Eq. 14 on the model itself, weighted, for the views of one step.

It samples the pair of times and the children of the temporal term, and the pairs of children of the rigidity term.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from graings.config import LossConfig
from graings.random import RandomStreams
from graings.scene.scene import Composition, Scene
from graings.training import losses

# Rigidity pairs each child with one at most so many slots later: a child of the same anchor or of one created near it.
REACH = 30

# Pairs count between these distances, in units of the scene's extent: farther ones belong to other objects, and the
# length of closer ones is dominated by rounding.
MIN_DISTANCE, MAX_DISTANCE = 1e-3, 0.2

# The temporal term samples at least about this many children: the paper sums over all, which costs half a step.
MIN_TEMPORAL_SAMPLE = 2_000


def regularisers(
    scene: Scene,
    compositions: Sequence[Composition],
    moments: Sequence[float],
    times: NDArray[np.float64],
    config: LossConfig,
    streams: RandomStreams,
) -> Float[Tensor, ""]:
    """lambda_1 L_temp + lambda_2 L_def + lambda_3 L_res of one step's `compositions`, and rigidity between them.

    Zero in the static phase. The views were composed together at the times `moments`; L_temp uses the first of them
    and one neighbouring training time per step. `times` are the capture's training times, ascending. Of `streams`,
    time_pairs samples the neighbour and the children, child_pairs the pairs of the rigidity term.
    """
    total = torch.zeros(())
    first = compositions[0]
    if len(first.children) == 0:
        return total
    if first.deformation is not None and config.temporal > 0 and len(times) > 1:
        # The sampled pair stands for all pairs, or for their mean.
        pairs = len(times) - 1 if config.temporal_sum else 1
        share, generator = config.temporal_share, streams["time_pairs"]
        total = total + config.temporal * pairs * _temporal(scene, first, moments[0], times, share, generator)
    if config.rigidity > 0:
        total = total + config.rigidity * _rigidity(compositions, float(scene.extent), streams["child_pairs"])
    if first.deformation is not None and config.deformation > 0:
        total = total + config.deformation * losses.deformation(first.deformation)
    for one in compositions:
        if one.residual is not None and config.residual > 0:
            total = total + config.residual * losses.residual(one.residual) / len(compositions)
    return total


def _temporal(
    scene: Scene,
    composition: Composition,
    time: float,
    times: NDArray[np.float64],
    share: float,
    generator: torch.Generator,
) -> Tensor:
    """Eq. 16 between this frame's time and one neighbouring training time, on a sample of the children."""
    assert composition.position_offsets is not None
    here = int(abs(times - time).argmin())
    side = 1 if int(torch.randint(2, (1,), generator=generator)) else -1
    there = here + side if 0 <= here + side < len(times) else here - side
    count = len(composition.children)
    share = max(share, MIN_TEMPORAL_SAMPLE / count)
    sample = (torch.rand(count, generator=generator) < share).nonzero().squeeze(-1)
    neighbour = scene.deform(composition.children[sample], composition.canonical_means[sample], float(times[there]))
    assert neighbour is not None
    gap = abs(float(times[there] - times[here]))
    mean_gap = float(times[-1] - times[0]) / (len(times) - 1)
    now, then = composition.position_offsets[sample], neighbour.position_offsets(0)
    return losses.temporal(now, then, gap, mean_gap)


def _rigidity(compositions: Sequence[Composition], extent: float, generator: torch.Generator) -> Tensor:
    """Strain of distances between children over the times of a step; canonical positions get no gradient."""
    offsets = [one.position_offsets for one in compositions if one.position_offsets is not None]
    canonical = compositions[0].canonical_means.detach()
    step = int(torch.randint(1, REACH + 1, (1,), generator=generator))
    if len(offsets) < 2 or len(canonical) <= step:
        return torch.zeros(())
    gaps = [((places := canonical + offset)[step:] - places[:-step]) / extent for offset in offsets]
    lengths = torch.stack([(gap.square().sum(-1) + MIN_DISTANCE**2 / 4).sqrt() for gap in gaps])
    mean = lengths.detach().mean(0)
    # The opacity of a child that only another view draws may be negative here; a negative weight would reward strain.
    opacities = torch.stack([one.gaussians.opacities.detach() for one in compositions]).amin(0).clamp_min(0.0)
    weights = torch.minimum(opacities[step:], opacities[:-step]) * ((mean > MIN_DISTANCE) & (mean < MAX_DISTANCE))
    return losses.rigidity(lengths, weights)
