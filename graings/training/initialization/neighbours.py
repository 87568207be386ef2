"""Distances of points to their nearest neighbours, without comparing every point with every other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

NEIGHBOURS: Final = 3

# Points of a group, which are compared with all of each other.
GROUP: Final = 2_048
# Points whose neighbours lie this many times farther than is usual in their group are taken a few at a time: the box
# around points must be wide enough for the one with the farthest neighbours.
FAR: Final = 2.0
FEW: Final = 32
# Distances in memory at once.
CHUNK: Final = 20_000_000


def neighbour_distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean squared distance of `points` [M, 3] to their three nearest neighbours, [M]; 1 for a single point.

    The neighbours within a group of nearby points bound how far the nearest of all points are; only points within this
    distance of the group are compared with it.
    """
    count = len(points)
    if count < 2:
        return np.ones(count)
    k = min(NEIGHBOURS, count - 1)
    bound, result = np.empty(count), np.empty(count)
    for group in _groups(points, np.arange(count), GROUP):
        bound[group] = _nearest(points[group], points[group], k)[:, -1].numpy()
        far = bound[group] > FAR * np.median(bound[group])
        for members in (group[~far], *_groups(points, group[far], FEW)):
            others = points[_around(points, points[members], bound[members].max())]
            result[members] = _nearest(points[members], others, k).square().mean(-1).sqrt().numpy()
    return result


def _groups(points: NDArray[np.float64], members: NDArray[np.int64], most: int) -> Iterator[NDArray[np.int64]]:
    """The indices `members` in groups of nearby points, halved along the longest side until at most `most` are left."""
    if len(members) <= most:
        if len(members):
            yield members
        return
    places, half = points[members], len(members) // 2
    order = np.argpartition(places[:, np.ptp(places, axis=0).argmax()], half)
    yield from _groups(points, members[order[:half]], most)
    yield from _groups(points, members[order[half:]], most)


def _around(points: NDArray[np.float64], some: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
    """Which points lie in the box of `some`, widened by `reach`; rounding must not exclude a point on its side."""
    wide = reach * (1 + 1e-9)
    return ((points >= some.min(0) - wide) & (points <= some.max(0) + wide)).all(1)


def _nearest(points: NDArray[np.float64], others: NDArray[np.float64], k: int) -> Tensor:
    """Distances [M, k] to the nearest of `others`, sorted, which hold the points themselves as well."""
    target = torch.from_numpy(others)
    return torch.cat(
        [
            torch.cdist(part, target, compute_mode="donot_use_mm_for_euclid_dist")
            .topk(k + 1, dim=-1, largest=False)
            .values[:, 1:]
            for part in torch.from_numpy(points).split(max(1, CHUNK // len(others)))
        ]
    )
