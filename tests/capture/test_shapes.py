"""Distance functions: exact on known points, and never larger than the true distance."""

from __future__ import annotations

import numpy as np
import pytest

from graings.capture.synthetic.deforming import ClosingTorus, Flag, closing_radius, closing_tube
from graings.capture.synthetic.exact import Array, lengths
from graings.capture.synthetic.pose import along, at
from graings.capture.synthetic.shapes import Ball, Box, Disc, Hoop, Room, RoundCone, Shape, Spokes

SHAPES: tuple[Shape, ...] = (
    Ball(0.4),
    RoundCone(0.5, 0.2, 0.1),
    Box((0.3, 0.2, 0.4), 0.05),
    Disc(0.4, 0.1, 0.02),
    Hoop(0.4, 0.1),
    Spokes(0.05, 0.5, 0.02, 3),
    ClosingTorus(closing_radius, closing_tube),
    Flag(0.9, 0.6, 0.02, 0.12, 1.3, 2.0, 0.1),
)
TIME = 0.3


def random_points(count: int, reach: float = 1.0) -> Array:
    return np.random.default_rng(0).uniform(-reach, reach, size=(3, count))


def column(x: float, y: float, z: float) -> Array:
    return np.array([[x], [y], [z]])


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_a_distance_never_grows_faster_than_the_way(shape: Shape) -> None:
    first = random_points(4000)
    second = first + 0.05 * random_points(4000)
    change = np.abs(shape.distance(first, TIME) - shape.distance(second, TIME))
    assert (change <= lengths(second - first) * (1 + 1e-9)).all()


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_box_and_sphere_hold_the_whole_shape(shape: Shape) -> None:
    low, high = (np.array(corner)[:, None] for corner in shape.box(TIME))
    points = 0.5 * (low + high) + 0.6 * (high - low) * random_points(50000)
    inside = points[:, shape.distance(points, TIME) < 0]
    assert inside.shape[1] > 100
    assert ((inside >= low) & (inside <= high)).all()
    center, radius = shape.bound(TIME)
    assert lengths(inside - np.array(center)[:, None]).max() <= radius + 1e-12


def test_points_of_a_flag_keep_their_coordinates_and_stay_on_its_surface() -> None:
    shape = Flag(0.9, 0.6, 0.02, 0.12, 1.3, 2.0, 0.1)
    part = 0.5 + 0.5 * random_points(200)
    material = np.stack([0.9 * part[0], np.where(part[1] < 0.5, -0.02, 0.02), 0.6 * part[2]])
    for time in (0.0, 0.4, 1.0):
        points = shape.place(material, time)
        assert np.abs(shape.distance(points, time)).max() < 1e-12
        np.testing.assert_allclose(shape.material(points, time), material, atol=1e-12)
    assert np.ptp(shape.place(material, 0.4) - shape.place(material, 0.0)) > 0.1


def test_outer_points_of_a_closing_torus_stay_on_its_surface() -> None:
    shape = ClosingTorus(closing_radius, closing_tube)
    around, across = np.pi * random_points(200)[0], 0.45 * np.pi * random_points(200)[1]
    reach = 2.0 + np.cos(across)
    material = np.stack([reach * np.cos(around), reach * np.sin(around), np.sin(across)])
    for time in (0.0, 0.4, 1.0):
        points = shape.place(material, time)
        assert np.abs(shape.distance(points, time)).max() < 1e-12
        np.testing.assert_allclose(shape.material(points, time), material, atol=1e-12)


def test_distances_of_known_points() -> None:
    assert Ball(0.4).distance(column(1.0, 0.0, 0.0), 0.0)[0] == pytest.approx(0.6)
    assert Box((0.3, 0.2, 0.4), 0.05).distance(column(0.0, 0.7, 0.0), 0.0)[0] == pytest.approx(0.5)
    assert Disc(0.4, 0.1).distance(column(0.1, 0.2, 0.5), 0.0)[0] == pytest.approx(0.4)
    assert Hoop(0.4, 0.1).distance(column(0.0, 0.0, 0.3), 0.0)[0] == pytest.approx(0.4)
    assert RoundCone(0.5, 0.2, 0.1).distance(column(0.0, 0.0, 1.0), 0.0)[0] == pytest.approx(0.4)
    assert Room((1.0, 2.0, 3.0)).distance(column(0.8, 0.0, 0.0), 0.0)[0] == pytest.approx(0.2)


@pytest.mark.parametrize("folds", [1, 2, 3])
def test_spokes_are_as_far_as_the_nearest_of_all_rods(folds: int) -> None:
    points = random_points(500)
    rods = []
    for index in range(2 ** (folds + 1)):
        angle = 2 * np.pi * index / 2 ** (folds + 1)
        axis = np.array([np.cos(angle), np.sin(angle), 0.0])
        nearest = np.clip(axis @ points, 0.1, 0.6)
        rods.append(lengths(points - axis[:, None] * nearest) - 0.02)
    np.testing.assert_allclose(Spokes(0.1, 0.6, 0.02, folds).distance(points, 0.0), np.min(rods, axis=0), atol=1e-12)


def test_the_hole_of_the_torus_closes() -> None:
    shape = ClosingTorus(closing_radius, closing_tube)
    center = column(0.0, 0.0, 0.0)
    assert shape.distance(center, 0.0)[0] > 0.3
    assert shape.distance(center, 1.0)[0] == pytest.approx(-closing_tube(1.0))
    np.testing.assert_allclose(
        shape.distance(random_points(50), 1.0), Ball(closing_tube(1.0)).distance(random_points(50), 0.0)
    )


def test_a_pose_and_its_inverse_cancel() -> None:
    pose = at(0.3, -0.2, 0.7).turned("x", 0.1).turned("y", 0.2).moved(0.1, 0.2, 0.3).turned("z", 0.4)
    points = random_points(20)
    np.testing.assert_allclose(pose.to_body(pose.to_world(points)), points, atol=1e-10)
    rows = np.array(pose.rows)
    np.testing.assert_allclose(rows @ rows.T, np.eye(3), atol=1e-10)


def test_a_pose_along_a_line_begins_and_ends_there() -> None:
    pose, length = along((0.1, 0.2, 0.3), (0.5, -0.4, 0.9))
    np.testing.assert_allclose(pose.to_world(column(0.0, 0.0, length))[:, 0], (0.5, -0.4, 0.9), atol=1e-12)
