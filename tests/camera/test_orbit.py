from __future__ import annotations

import math

import numpy as np
import pytest

from graings.camera.camera import Camera
from graings.camera.orbit import azimuths, elevations, one_side

UPS = [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.3, -0.8, 0.5)]


def arms(angles: list[float], up: tuple[float, float, float], elevation: float = 20.0) -> np.ndarray:
    cameras = [Camera.orbit(a, elevation, 2.0, up=up, fov=0.7, width=40, height=30) for a in angles]
    return np.stack([camera.center for camera in cameras])


@pytest.mark.parametrize("up", UPS)
def test_the_angles_of_an_orbit_are_read_back_from_its_cameras(up: tuple[float, float, float]) -> None:
    angles = [-170.0, -90.0, 0.0, 12.5, 179.0]
    np.testing.assert_allclose(azimuths(arms(angles, up), up), angles, atol=1e-9)
    np.testing.assert_allclose(elevations(arms(angles, up, -35.0), up), -35.0, atol=1e-9)


def test_a_camera_at_the_point_that_it_looks_at_has_angles_zero() -> None:
    assert azimuths([0.0, 0.0, 0.0], UPS[0]) == elevations([0.0, 0.0, 0.0], UPS[0]) == 0.0


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("middle", [0.0, 100.0, 180.0, -91.0])
@pytest.mark.parametrize("width", [0.0, 10.0, 180.0, 260.0])
def test_cameras_on_an_arc_are_on_the_side_of_its_middle(
    up: tuple[float, float, float], middle: float, width: float
) -> None:
    side = one_side(arms([middle + width * (k / 40 - 0.5) for k in range(41)], up), up)
    assert side is not None
    assert abs(math.remainder(side - middle, 360.0)) < 1e-6


@pytest.mark.parametrize("count", [2, 3, 7, 36])
def test_cameras_all_around_have_no_side(count: int) -> None:
    assert one_side(arms([360.0 * k / count for k in range(count)], UPS[0]), UPS[0]) is None


def test_cameras_at_random_all_around_have_no_side() -> None:
    angles = np.random.default_rng(0).uniform(0.0, 360.0, 150)
    assert one_side(arms(angles.tolist(), UPS[0]), UPS[0]) is None
