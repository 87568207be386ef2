"""Distances to the nearest neighbours are those of all pairs, to the bit, however the points are grouped."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from graings.training.initialization import neighbours
from graings.training.initialization.neighbours import NEIGHBOURS, neighbour_distance

RANDOM = np.random.default_rng(7)
POINTS = {
    "none": np.zeros((0, 3)),
    "one": np.ones((1, 3)),
    "two": np.array([[0.0, 0, 0], [0, 3, 4]]),
    "box": RANDOM.random((700, 3)),
    "pairs": np.repeat(RANDOM.random((200, 3)), 2, 0),
    "all at one place": np.full((300, 3), 0.5),
    "line": np.stack([np.arange(400.0), np.zeros(400), np.zeros(400)], 1),
    "clusters far apart": np.concatenate([RANDOM.normal(size=(300, 3)) + 1e6 * k for k in range(3)]),
    "dense with outliers": np.concatenate([1e-3 * RANDOM.normal(size=(500, 3)), 1e3 * RANDOM.normal(size=(60, 3))]),
}


def of_all_pairs(points: NDArray[np.float64]) -> NDArray[np.float64]:
    places = torch.from_numpy(points)
    distances = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
    nearest = distances.sort(dim=-1).values[:, 1 : NEIGHBOURS + 1]
    return np.asarray(nearest.square().mean(-1).sqrt())


@pytest.mark.parametrize("name", list(POINTS))
@pytest.mark.parametrize("group", [8, 64, 10_000])
def test_grouping_changes_no_bit(name: str, group: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbours, "GROUP", group)
    points = POINTS[name]
    expected = of_all_pairs(points) if len(points) > 1 else np.ones(len(points))
    np.testing.assert_array_equal(neighbour_distance(points), expected)


def test_far_fewer_pairs_are_compared_than_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = []
    nearest = neighbours._nearest

    def counted(points: NDArray[np.float64], others: NDArray[np.float64], k: int) -> torch.Tensor:
        compared.append(len(points) * len(others))
        return nearest(points, others, k)

    monkeypatch.setattr(neighbours, "_nearest", counted)
    points = np.concatenate([RANDOM.random((40_000, 3)), 30 * RANDOM.normal(size=(2_000, 3))])
    neighbour_distance(points)
    assert sum(compared) < 0.3 * len(points) ** 2
