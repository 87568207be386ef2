"""Where anchors grow and which are pruned: decisions only, the optimiser resizes the scene.

Growth follows the mean screen-space gradient of each child (Eq. 6) on a multi-resolution voxel grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from graings.config import DensityConfig
from graings.scene.scaffold import Scaffold
from graings.training.density.statistics import DensityStatistics

# Never prune below this many anchors.
MIN_ANCHORS = 16

# `max_growth` of few anchors would be next to nothing: so many may be added at once in any case.
MIN_GROWTH = 1_000

# A cell of the next finer level is this many times smaller.
LEVEL_DIVISOR = 4


@dataclass(frozen=True, slots=True)
class Growth:
    """New anchors: rows for every name in `Scaffold.ROWS`, and whether a budget cut the list."""

    rows: dict[str, Tensor]
    capped: bool

    def __len__(self) -> int:
        return len(self.rows["anchors"])


def voxel_keys(positions: Float[Tensor, "point 3"], cell: float) -> Int64[Tensor, "point 3"]:
    """Integer cell of each position: round(x / cell) in float64, so that far coordinates keep their cell."""
    return torch.floor(positions.double() / cell + 0.5).to(torch.int64)


def grow(
    scaffold: Scaffold,
    statistics: DensityStatistics,
    logits: Float[Tensor, "anchor child"],
    config: DensityConfig,
    voxel_size: float,
    next_uid: int,
    generator: torch.Generator,
) -> Growth:
    """Choose new anchors (Eq. 6 and the paragraph below it).

    A child is a candidate on level i when drawn more than tau_obs times with a mean gradient of at least
    tau_g 2^i; 1 - 2^-(i+1) of them are kept at random. Cells shrink 4-fold per level down to `voxel_size`. Each
    free cell gets one anchor at its node with the element-wise maximum of the candidates' features, zero
    offsets and a scale of one cell. `logits` are the opacity logits of every slot at the mean direction.
    """
    observed = statistics.drawn > config.min_observations
    mean = torch.where(observed, statistics.gradient / statistics.drawn.clamp_min(1), 0.0).flatten()
    anchors = scaffold.anchors.detach()
    positions = (
        anchors.unsqueeze(1) + scaffold.log_scales.detach().exp().unsqueeze(1) * scaffold.offsets.detach()
    ).flatten(0, 1)
    fresh: dict[str, list[Tensor]] = {"anchors": [], "features": [], "log_scales": [], "score": [], "parent": []}
    existing = anchors
    for level in range(config.levels):
        cell = voxel_size * max(1, LEVEL_DIVISOR ** (config.levels - 1 - level))
        kept = torch.rand(len(mean), generator=generator) > 0.5 ** (level + 1)
        chosen = (observed.flatten() & (mean >= config.gradient_threshold * 2.0**level) & kept).nonzero().squeeze(-1)
        if len(chosen) == 0:
            continue
        cells, member = torch.unique(voxel_keys(positions[chosen], cell), dim=0, return_inverse=True)
        free = ~_contains(torch.unique(voxel_keys(existing, cell), dim=0), cells)
        inside = free[member]
        place = torch.cumsum(free, 0) - 1
        count = int(free.sum())
        if count == 0:
            continue
        member, chosen = place[member[inside]], chosen[inside]
        owners = chosen // scaffold.slots
        features = torch.full((count, scaffold.features.shape[1]), -math.inf)
        features = features.scatter_reduce(
            0, member.unsqueeze(-1).expand(-1, features.shape[1]), scaffold.features.detach()[owners], "amax"
        )
        score = torch.zeros(count, dtype=torch.float64).scatter_reduce(0, member, mean[chosen], "amax")
        # The parent is the candidate with the largest gradient in the cell, the lowest slot on a tie.
        parent = torch.full((count,), len(mean), dtype=torch.int64)
        best = mean[chosen] == score[member]
        parent = parent.scatter_reduce(0, member[best], chosen[best], "amin") // scaffold.slots
        nodes = (cells[free].double() * cell).to(anchors.dtype)
        fresh["anchors"].append(nodes)
        fresh["features"].append(features)
        fresh["log_scales"].append(torch.full((count, 3), math.log(cell)))
        fresh["score"].append(score)
        fresh["parent"].append(parent)
        existing = torch.cat([existing, nodes])
    if not fresh["anchors"]:
        return Growth(_empty_rows(scaffold), capped=False)
    new = {name: torch.cat(parts) for name, parts in fresh.items()}
    room = len(new["score"])
    if config.max_anchors is not None:
        room = min(room, max(0, config.max_anchors - scaffold.count))
    if config.max_growth is not None:
        room = min(room, max(MIN_GROWTH, int(config.max_growth * scaffold.count)))
    order = torch.argsort(new["score"], descending=True, stable=True)[:room].sort().values
    return Growth(
        {
            "anchors": new["anchors"][order],
            "uids": next_uid + torch.arange(len(order)),
            "log_scales": new["log_scales"][order],
            "features": new["features"][order],
            "offsets": torch.zeros(len(order), scaffold.slots, 3),
            "opacity_offsets": new_anchor_opacity_offsets(
                scaffold, logits, new["parent"][order], config.new_anchor_opacity
            ),
        },
        capped=len(order) < len(new["score"]),
    )


def new_anchor_opacity_offsets(
    scaffold: Scaffold,
    logits: Float[Tensor, "anchor child"],
    parents: Int64[Tensor, " new"],
    opacity: float | None,
) -> Float[Tensor, " new"] | Float[Tensor, "new child"]:
    """Opacity offsets of new anchors.

    With an offset for each child, each child starts at `opacity`; with one for each anchor the most opaque child does,
    or lower where its parent is. None inherits the parent's offsets as they are.
    """
    inherited = scaffold.opacity_offsets.detach()[parents]
    if opacity is None:
        return inherited
    # `logits` contain the parent's offsets, so the correction adds to them.
    missing = math.atanh(opacity) - logits[parents]
    return inherited + (missing if inherited.dim() == 2 else missing.amin(-1).clamp_max(0.0))


def prune(scaffold: Scaffold, statistics: DensityStatistics, config: DensityConfig) -> Bool[Tensor, " anchor"]:
    """True for every anchor to keep: not visited often enough yet, or with a mean opacity above the threshold."""
    visited = statistics.visits > config.prune_min_views
    faint = visited & (statistics.opacity < config.prune_opacity * statistics.visits)
    keep = ~faint
    if int(keep.sum()) < min(MIN_ANCHORS, scaffold.count):
        return torch.ones_like(keep)
    return keep


def thin_out(
    scaffold: Scaffold, statistics: DensityStatistics, most: int, generator: torch.Generator
) -> tuple[Bool[Tensor, " anchor"], Float[Tensor, " anchor"]]:
    """Which `most` of more anchors stay, and what is added to the log-scale of each so that no gaps appear.

    Half of those that stay have the largest gradients; the others are a random sample of the rest (a floor or a wall)
    and become larger by the area of those that are removed. Not in the paper, which has no budget.
    """
    gradient = (statistics.gradient / statistics.drawn.clamp_min(1)).amax(dim=-1)
    order = torch.argsort(gradient, descending=True, stable=True)
    largest, rest = order[: most // 2], order[most // 2 :]
    stay = rest[torch.randperm(len(rest), generator=generator)[: most - len(largest)]]
    keep = torch.zeros(scaffold.count, dtype=torch.bool)
    keep[largest] = True
    keep[stay] = True
    wider = scaffold.log_scales.new_zeros(scaffold.count)
    wider[stay] = 0.5 * math.log(len(rest) / len(stay))  # they cover surfaces
    return keep, wider


def _contains(occupied: Int64[Tensor, "cell 3"], cells: Int64[Tensor, "query 3"]) -> Bool[Tensor, " query"]:
    """Which of `cells` are among `occupied` (both without duplicates)."""
    _, group, counts = torch.unique(torch.cat([occupied, cells]), dim=0, return_inverse=True, return_counts=True)
    return counts[group[len(occupied) :]] > 1


def _empty_rows(scaffold: Scaffold) -> dict[str, Tensor]:
    return {name: getattr(scaffold, name).detach()[:0] for name in Scaffold.ROWS}
