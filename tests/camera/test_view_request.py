from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from graings.camera.camera import Camera, View
from graings.camera.units import Units
from graings.camera.view_request import MAX_SIDE, ViewRequest
from graings.camera.viewpoint import orbit_view

UNITS = Units(center=(1.0, -2.0, 3.0), scale=0.25)
BACKGROUND = (0.25, 0.5, 0.75)
VIEWS = {
    "train": tuple(
        View(f"r_{i}", Camera.orbit(40.0 * i, 10.0 * i, 1.5, fov=0.7, width=40, height=30), 0.5) for i in range(3)
    )
}
POSE: dict[str, object] = {"world_to_camera": np.eye(4).tolist(), "fx": 50.0, "width": 40, "height": 30}


def resolve(**parameters: Any) -> tuple[Camera, float, tuple[float, float, float]]:
    return ViewRequest(**parameters).resolve(VIEWS, UNITS, BACKGROUND)


def test_without_parameters_it_is_the_default_orbit_at_time_0_on_the_models_background() -> None:
    camera, time, background = resolve()
    np.testing.assert_array_equal(camera.world_to_camera, orbit_view(VIEWS["train"], UNITS).world_to_camera)
    assert (time, background) == (0.0, BACKGROUND)
    assert ViewRequest().is_orbit


def test_parameters_of_an_orbit_are_those_of_orbit_view() -> None:
    orbit: dict[str, Any] = {"azimuth": 30.0, "elevation": 5.0, "radius": 8.0, "target": (1.0, 0.0, 2.0), "fov": 50.0}
    camera, _, _ = resolve(**orbit, width=80, height=20)
    expected = orbit_view(VIEWS["train"], UNITS, **orbit, width=80, height=20)
    np.testing.assert_array_equal(camera.world_to_camera, expected.world_to_camera)
    assert (camera.fx, camera.width, camera.height) == (expected.fx, 80, 20)


def test_a_named_view_has_its_own_time_unless_another_is_given() -> None:
    camera, time, _ = resolve(camera="train:1", width=80)
    np.testing.assert_array_equal(camera.world_to_camera, VIEWS["train"][1].camera.world_to_camera)
    assert (camera.width, camera.height, time) == (80, 60, 0.5)
    assert resolve(camera="train:1", t=0.25)[1] == 0.25


@pytest.mark.parametrize(("given", "resolved"), [(-1.0, 0.0), (1.5, 1.0)])
def test_a_time_outside_the_capture_is_clamped(given: float, resolved: float) -> None:
    assert resolve(t=given)[1] == resolved


def test_a_pose_in_the_captures_units_needs_only_matrix_focal_length_and_size() -> None:
    camera, time, _ = resolve(pose=POSE)
    np.testing.assert_array_equal(camera.world_to_camera, UNITS.camera(np.eye(4)))
    assert (camera.fx, camera.fy, camera.cx, camera.cy, time) == (50.0, 50.0, 20.0, 15.0, 0.0)
    camera, _, _ = resolve(pose={**POSE, "fy": 55.0, "cx": 0, "cy": 14.0}, width=80)
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (100, 110, 0, 28, 80, 60)


def test_a_background_is_read_from_its_text() -> None:
    assert resolve(background="#ff0033")[2] == (1.0, 0.0, 0.2)


@pytest.mark.parametrize(
    ("parameters", "word"),
    [
        ({"camera": "train:0", "azimuth": 1.0}, "choose one viewpoint.*camera, azimuth"),
        ({"camera": "train:0", "pose": {"fx": 50.0}}, "choose one viewpoint.*camera, pose"),
        ({"fov": 40.0, "pose": POSE}, "choose one viewpoint.*fov, pose"),
        ({"t": math.nan}, "t must be"),
        ({"background": "pink"}, "background"),
        ({"camera": "test:0"}, "camera"),
        ({"elevation": 91.0}, "elevation"),
        ({"width": 0}, "width"),
        ({"width": MAX_SIDE + 1}, f"at most {MAX_SIDE}"),
        ({"camera": "train:0", "height": MAX_SIDE}, f"at most {MAX_SIDE}"),  # 4 : 3
    ],
)
def test_an_impossible_request_is_refused_by_the_name_of_its_parameter(parameters: dict[str, Any], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        resolve(**parameters)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"fx": None, "height": None}, "fx, height missing"),
        ({"width": MAX_SIDE + 1}, f"width must be a whole number from 1 to {MAX_SIDE}"),
        ({"height": 24.5}, "height must be a whole number"),
        ({"width": True}, "width must be a whole number"),
        ({"width": "24"}, "width must be a whole number"),
        ({"fx": 10**400}, "fx must be a finite number"),
        ({"fy": "50"}, "fy must be a finite number"),
        ({"cx": math.inf}, "cx must be a finite number"),
        ({"cy": True}, "cy must be a finite number"),
        ({"fx": -1.0}, "fx, fy > 0"),
        ({"world_to_camera": [[10**400, 0, 0, 0]] * 4}, "world_to_camera must be four rows"),
        ({"world_to_camera": [[1, 2], [3]]}, "world_to_camera must be four rows"),
        ({"world_to_camera": [[1.0]]}, r"shape \(4, 4\)"),
        ({"world_to_camera": (2.0 * np.eye(4)).tolist()}, "rigid"),
    ],
)
def test_a_pose_with_a_wrong_value_is_refused_by_its_name(change: dict[str, object], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        resolve(pose=POSE | change)


def test_an_orbit_without_training_views_is_refused() -> None:
    with pytest.raises(ValueError, match="training views"):
        ViewRequest().resolve({}, UNITS, BACKGROUND)
