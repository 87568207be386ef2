from __future__ import annotations

import math

import numpy as np
import pytest

from graings.camera.camera import Camera, View
from graings.camera.units import Units
from graings.camera.viewpoint import background_rgb, named_view, orbit_view, pose_camera, sized

UNITS = Units(center=(1.0, -2.0, 3.0), scale=0.25)


def ring(elevations: tuple[float, ...], radius: float) -> tuple[View, ...]:
    """Views around the scene's centre; `radius` in normalised units."""
    return tuple(
        View(f"r_{i}", Camera.orbit(40.0 * i, e, radius, fov=0.7, width=40, height=30), 0.0)
        for i, e in enumerate(elevations)
    )


def test_orbit_takes_radius_elevation_angle_and_size_from_the_training_views() -> None:
    camera = orbit_view(ring((10.0, 20.0, 60.0), radius=1.5), UNITS, azimuth=15.0)
    assert math.isclose(float(np.linalg.norm(camera.center)), 1.5, rel_tol=1e-12)
    assert math.isclose(math.degrees(math.asin(camera.center[2] / 1.5)), 20.0, rel_tol=1e-12)
    assert math.isclose(camera.horizontal_fov, 0.7, rel_tol=1e-12)
    assert (camera.width, camera.height) == (40, 30)


@pytest.mark.parametrize(("angles", "azimuth"), [((100.0, 110.0, 150.0), 119.4), ((0.0, 120.0, 240.0), 0.0)])
def test_an_orbit_begins_on_the_side_of_the_training_views_if_they_have_one(
    angles: tuple[float, ...], azimuth: float
) -> None:
    cameras = [Camera.orbit(angle, 20.0, 1.5, fov=0.7, width=40, height=30) for angle in angles]
    camera = orbit_view([View("v", camera, 0.0) for camera in cameras], UNITS)
    expected = Camera.orbit(azimuth, 20.0, 1.5, fov=0.7, width=40, height=30)
    np.testing.assert_allclose(camera.center, expected.center, atol=0.01)


def test_orbit_reads_radius_and_target_in_the_captures_units() -> None:
    target = np.array([2.0, 0.0, 1.0])
    camera = orbit_view(ring((0.0,), 1.0), UNITS, azimuth=30.0, elevation=25.0, radius=8.0, target=target, fov=50.0)
    eye = UNITS.points_back(camera.center)
    assert math.isclose(float(np.linalg.norm(eye - target)), 8.0, rel_tol=1e-12)
    assert math.isclose(eye[2] - target[2], 8.0 * math.sin(math.radians(25.0)), rel_tol=1e-12)
    np.testing.assert_allclose(camera.forward, (target - eye) / 8.0, atol=1e-12)


def test_training_views_that_turn_on_the_spot_have_an_orbit_about_it() -> None:
    turning = [
        View("v", Camera.look_at((0, 0, 0), (math.cos(a), math.sin(a), 0.0), fov=0.7, width=40, height=30), 0.0)
        for a in np.linspace(0, 5, 12)
    ]
    camera = orbit_view(turning, UNITS)
    assert math.isclose(float(np.linalg.norm(camera.center)), 0.01, rel_tol=1e-9)


def test_a_camera_at_the_target_has_elevation_zero() -> None:
    at_center = View("c", Camera(np.eye(4), 50.0, 50.0, 20.0, 15.0, 40, 30), 0.0)
    camera = orbit_view((at_center,), UNITS, radius=4.0)
    assert abs(camera.center[2]) < 1e-12


def test_width_or_height_alone_keeps_the_aspect_ratio() -> None:
    camera = orbit_view(ring((0.0,), 1.0), UNITS, width=80)
    assert (camera.width, camera.height) == (80, 60)
    assert (sized(camera, height=30).width, sized(camera, height=30).height) == (40, 30)


def test_resizing_to_another_shape_keeps_pixels_square_and_the_axis_in_place() -> None:
    camera = Camera(np.eye(4), 50.0, 50.0, 21.0, 14.0, 40, 30)
    wide = sized(camera, 80, 20)
    assert wide.fx == wide.fy == 100.0
    assert wide.horizontal_fov == camera.horizontal_fov
    assert (wide.cx, wide.cy) == (42.0, 8.0)  # 1 px above the middle becomes 2 px above it


@pytest.mark.parametrize(
    ("request_", "word"),
    [
        ({"elevation": 91.0}, "elevation"),
        ({"radius": 0.0}, "radius"),
        ({"radius": math.inf}, "radius"),
        ({"radius": 1e308}, "radius"),
        ({"radius": 1e-300}, "radius"),
        ({"target": (1e308, 0.0, 0.0)}, "target"),
        ({"azimuth": math.nan}, "azimuth"),
        ({"fov": 180.0}, "fov"),
        ({"target": (0.0, 0.0)}, "target"),
        ({"target": (0.0, math.nan, 0.0)}, "target"),
        ({"width": 0}, "width"),
        ({"height": -3}, "height"),
    ],
)
def test_an_impossible_orbit_is_refused_by_the_name_of_its_parameter(request_: dict[str, object], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        orbit_view(ring((0.0,), 1.0), UNITS, **request_)  # type: ignore[arg-type]


def test_an_orbit_without_training_views_is_refused() -> None:
    with pytest.raises(ValueError, match="training views"):
        orbit_view((), UNITS)


def test_a_view_is_found_by_split_and_index() -> None:
    views = {"train": ring((0.0, 10.0), 1.0), "test": ring((5.0,), 1.0)}
    assert named_view(views, "train:1") is views["train"][1]


@pytest.mark.parametrize("name", ["test", "test:", "test:-1", "test:x", "test:\u00b2", "3", ""])
def test_a_malformed_view_name_is_refused_with_an_example(name: str) -> None:
    with pytest.raises(ValueError, match="train:0"):
        named_view({"test": ring((0.0,), 1.0)}, name)


def test_a_view_that_does_not_exist_is_refused_with_those_that_do() -> None:
    views = {"train": ring((0.0, 10.0), 1.0), "val": ()}
    with pytest.raises(ValueError, match="train:0 to train:1"):
        named_view(views, "train:2")
    with pytest.raises(ValueError, match="no views"):
        named_view(views, "val:0")
    with pytest.raises(ValueError, match="only train, val"):
        named_view(views, "test:0")


def test_a_pose_in_capture_units_sees_the_same_pixels_after_normalising() -> None:
    pose = np.eye(4)
    pose[:3, 3] = (0.3, -0.2, 5.0)
    camera = pose_camera(UNITS, pose, 50.0, 55.0, 20.0, 15.0, 40, 30)
    point = np.array([0.4, 0.1, 1.0])
    before = pose[:3, :3] @ point + pose[:3, 3]
    after = camera.world_to_camera[:3, :3] @ UNITS.points(point) + camera.world_to_camera[:3, 3]
    np.testing.assert_allclose(after[:2] / after[2], before[:2] / before[2], rtol=1e-12)


def test_a_pose_of_the_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\(4, 4\)"):
        pose_camera(UNITS, np.eye(3), 50.0, 50.0, 20.0, 15.0, 40, 30)


@pytest.mark.parametrize(
    ("text", "color"),
    [
        ("white", (1.0, 1.0, 1.0)),
        (" Black ", (0.0, 0.0, 0.0)),
        ("#ff0033", (1.0, 0.0, 0.2)),
        ("0.25, 0.5,1", (0.25, 0.5, 1.0)),
    ],
)
def test_a_background_is_a_name_a_hex_code_or_three_numbers(text: str, color: tuple[float, float, float]) -> None:
    assert background_rgb(text) == color


@pytest.mark.parametrize("text", ["", "pink", "#fff", "#gg0000", "#+1+2+3", "1,1", "0,0,2", "nan,0,0", "0,0,0,0"])
def test_an_invalid_background_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="background must be white"):
        background_rgb(text)
