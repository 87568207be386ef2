"""The score of motion: zero for true motion, the size of the motion for a model that stands still."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from graings.evaluation.motion import follow, measure_motion, motion_error
from tests.models import EYE, tiny_scene

TIMES = (0.0, 0.25, 0.5, 1.0)


def cloud(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, size=(count, 3))


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def test_points_move_with_the_gaussians_around_them() -> None:
    points, means = cloud(60), cloud(3000, seed=1)
    shift = np.array([0.3, -0.1, 0.2])
    displacements = np.stack([np.broadcast_to(time * shift, means.shape) for time in TIMES])
    followed = follow(points, means, np.full(3000, 0.8), displacements)
    np.testing.assert_allclose(followed, np.stack([points + time * shift for time in TIMES]), atol=1e-12)


def test_true_rotation_leaves_a_small_error_that_falls_with_density() -> None:
    points = cloud(60)
    truth = np.stack([turned(points, time) for time in TIMES])
    errors = []
    for count in (300, 30000):
        means = cloud(count, seed=1)
        displacements = np.stack([turned(means, time) - means for time in TIMES])
        errors.append(motion_error(follow(points, means, np.full(count, 0.8), displacements), truth).mean)
    assert errors[1] < 0.3 * errors[0]
    assert errors[1] < 0.01


def test_the_opacity_weighs_the_neighbours() -> None:
    point = np.zeros((1, 3))
    means = np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]])
    displacements = np.stack([np.zeros((2, 3)), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])])
    followed = follow(point, means, np.array([0.9, 0.3]), displacements)
    assert followed[1, 0, 0] == pytest.approx(0.75)


def test_errors_are_in_units_of_the_box_around_all_positions() -> None:
    truth = np.array([[[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], [[0.0, 4.0, 0.0], [3.0, 4.0, 0.0]]])  # diagonal 5
    followed = truth.copy()
    followed[1, 1] += (0.0, 0.0, 1.0)
    metrics = motion_error(followed, truth)
    assert metrics.mean == pytest.approx(0.1)
    assert metrics.percentile_90 == pytest.approx(0.18)
    assert metrics.mean_at_rest == pytest.approx(0.8)
    assert (metrics.points, metrics.times) == (2, 2)


def test_an_untrained_scene_stands_still() -> None:
    truth = np.stack([turned(cloud(40), time) for time in TIMES])
    metrics = measure_motion(tiny_scene(trained=False), EYE, TIMES, truth)
    assert metrics is not None
    assert metrics.mean == pytest.approx(metrics.mean_at_rest, abs=1e-6)
    assert metrics.mean_at_rest > 0.05


def test_a_scene_that_moves_is_followed() -> None:
    scene = tiny_scene(anchors=200)
    with torch.no_grad():
        first = scene.compose(EYE, TIMES[0])
        means = first.gaussians.means.double().numpy()
        moved = [scene.deform(first.children, first.canonical_means, time) for time in TIMES]
    offsets = np.stack(
        [deformation.position_offsets(0).double().numpy() for deformation in moved if deformation is not None]
    )
    metrics = measure_motion(scene, EYE, TIMES, means + offsets - offsets[0])
    assert metrics is not None
    assert metrics.mean_at_rest > 0.001
    assert metrics.mean < 0.5 * metrics.mean_at_rest


def test_a_static_scene_has_the_error_of_standing_still() -> None:
    truth = np.stack([turned(cloud(40), time) for time in TIMES])
    metrics = measure_motion(tiny_scene(temporal=False), EYE, TIMES, truth)
    assert metrics is not None
    assert metrics.mean == pytest.approx(metrics.mean_at_rest, abs=1e-6)


def test_one_time_has_no_motion_to_score() -> None:
    assert measure_motion(tiny_scene(), EYE, TIMES[:1], cloud(40)[None]) is None
