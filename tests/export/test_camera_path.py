"""Camera paths."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graings.camera.camera import Camera, View
from graings.camera.orbit import azimuths
from graings.camera.view_request import ViewRequest
from graings.errors import CheckpointError
from graings.export.camera_path import PathKey, frames_of, spline
from graings.export.shown import Shown
from tests.export.models import UNITS, ring, tiny_shown

WHITE = (1.0, 1.0, 1.0)


def test_time_runs_at_a_fixed_camera() -> None:
    frames = frames_of(tiny_shown(), ViewRequest(camera="train:3"), "orbit", "time", 5)
    assert [time for _, time in frames] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert all(camera is frames[0][0] for camera, _ in frames)


def test_an_orbit_goes_around_once_at_a_frozen_time() -> None:
    frames = frames_of(tiny_shown(), ViewRequest(azimuth=10.0, t=0.3), "orbit", "camera", 8)
    assert [time for _, time in frames] == [0.3] * 8
    centers = np.stack([camera.center for camera, _ in frames])
    steps = np.linalg.norm(np.roll(centers, -1, axis=0) - centers, axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)  # the last frame is as far from the first as others
    assert [time for _, time in frames_of(tiny_shown(), ViewRequest(), "orbit", "both", 3)] == [0.0, 0.5, 1.0]


def test_a_path_through_views_is_smooth_closed_and_looks_at_the_scene() -> None:
    frames = frames_of(tiny_shown(), ViewRequest(), "views", "camera", 64)
    centers = np.stack([camera.center for camera, _ in frames])
    steps = np.linalg.norm(np.roll(centers, -1, axis=0) - centers, axis=1)
    assert steps.max() < 0.6  # of a way of about 15
    for camera, _ in frames:
        toward = -camera.center / np.linalg.norm(camera.center)
        assert camera.forward @ toward > math.cos(math.radians(25))


def one_sided(middle: float) -> Shown:
    """Training views over 60 degrees of azimuth."""
    whole = tiny_shown()
    cameras = [Camera.orbit(middle + 6.0 * k, 20.0, 4.0, fov=0.7, width=32, height=24) for k in range(-5, 6)]
    return replace(whole, views={"train": tuple(View(f"v{k}", c, 0.0) for k, c in enumerate(cameras))})


@pytest.mark.parametrize("path", [None, "views"])
@pytest.mark.parametrize("middle", [0.0, 130.0, 180.0])
def test_a_video_of_a_capture_from_one_side_stays_there_and_never_jumps(path: str | None, middle: float) -> None:
    frames = frames_of(one_sided(middle), ViewRequest(), path, "camera", 60)
    angles = azimuths(np.stack([camera.center for camera, _ in frames]), UNITS.up)
    away = np.remainder(angles - middle + 180.0, 360.0) - 180.0
    assert -35.0 < away.min() < -25.0 < 20.0 < away.max() < 35.0
    assert np.abs(np.diff(np.append(away, away[0]))).max() < 5.0  # 120 degrees in 60 frames


def test_an_orbit_that_is_asked_for_goes_around_a_capture_from_one_side() -> None:
    for path, request in (("orbit", ViewRequest()), (None, ViewRequest(azimuth=130.0))):
        frames = frames_of(one_sided(130.0), request, path, "camera", 36)
        angles = azimuths(np.stack([camera.center for camera, _ in frames]), UNITS.up)
        away = np.remainder(angles - angles[0] + 1.0, 360.0) - 1.0
        assert abs(angles[0] - 130.0) < 1e-6
        np.testing.assert_allclose(away, np.arange(36) * 10.0, atol=1e-6)


def test_a_video_of_a_capture_from_all_sides_goes_around_it() -> None:
    frames = frames_of(tiny_shown(), ViewRequest(), None, "camera", 8)
    turned = frames_of(tiny_shown(), ViewRequest(), "orbit", "camera", 8)
    for (camera, _), (expected, _) in zip(frames, turned, strict=True):
        np.testing.assert_array_equal(camera.world_to_camera, expected.world_to_camera)


def test_a_spline_passes_through_its_keys() -> None:
    keys = [PathKey(camera, time) for camera, time in zip(ring(4), (0.0, 0.2, 0.9, 1.0), strict=True)]
    found = spline(keys, 10)
    for index, key in enumerate(keys):
        np.testing.assert_allclose(found[3 * index].camera.world_to_camera, key.camera.world_to_camera, atol=1e-9)
        assert found[3 * index].time == pytest.approx(key.time)
    closed = spline(keys, 8, closed=True)
    np.testing.assert_allclose(closed[6].camera.world_to_camera, keys[3].camera.world_to_camera, atol=1e-9)


def test_a_file_of_keys_may_name_views_orbits_and_times(tmp_path: Path) -> None:
    keys = [{"camera": "train:0", "t": 1.0}, {"azimuth": 90, "elevation": 20, "t": 0.0}]
    (tmp_path / "keys.json").write_text(json.dumps({"keys": keys}))
    scene = tiny_shown()
    frames = frames_of(scene, ViewRequest(), str(tmp_path / "keys.json"), "both", 3)
    assert [time for _, time in frames] == [1.0, 0.5, 0.0]
    first = scene.views["train"][0].camera
    np.testing.assert_allclose(frames[0][0].world_to_camera, first.world_to_camera, atol=1e-9)
    frozen = frames_of(scene, ViewRequest(t=0.7), str(tmp_path / "keys.json"), "camera", 3)
    assert [time for _, time in frozen] == [0.7] * 3


def test_nerfstudio_files_are_followed_frame_by_frame(tmp_path: Path) -> None:
    scene = tiny_shown()
    wanted = [view.camera for view in scene.views["train"][:3]]
    entries = []
    for camera in wanted:
        pose = np.linalg.inv(UNITS.camera_back(camera))
        pose[:3, 1:3] *= -1
        fov = math.degrees(2 * math.atan(0.5 * camera.height / camera.fy))
        entries.append({"camera_to_world": pose.ravel().tolist(), "fov": fov, "aspect": 1.0})
    document = {"camera_path": entries, "render_width": 40, "render_height": 40, "fps": 24, "seconds": 1}
    (tmp_path / "camera_path.json").write_text(json.dumps(document))
    frames = frames_of(scene, ViewRequest(), str(tmp_path / "camera_path.json"), "both", 100)
    assert [time for _, time in frames] == [0.0, 0.5, 1.0]
    for (camera, _), expected in zip(frames, wanted, strict=True):
        np.testing.assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-9)
        assert camera.fx == pytest.approx(expected.fx)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("nothing", "no camera path"),
        ("[]", "JSON object"),
        ('{"keys": []}', "list of keys"),
        ('{"keys": [{"azimut": 3}]}', "no azimut"),
        ('{"keys": [{"camera": "test:9"}]}', "test"),
        ('{"keys": [{"t": 0}, {}]}', "every key or for none"),
        ('{"camera_path": [], "render_width": 4, "render_height": 4}', "empty"),
        ('{"camera_path": [{"fov": 50}], "render_width": 4, "render_height": 4}', "camera_to_world"),
    ],
)
def test_a_broken_path_is_refused_with_its_name(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(CheckpointError, match=rf"a\.json: .*{message}"):
        frames_of(tiny_shown(), ViewRequest(), str(tmp_path / "a.json"), "both", 3)


def test_wrong_requests_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one frame"):
        frames_of(tiny_shown(), ViewRequest(), "orbit", "both", 0)
    with pytest.raises(ValueError, match="orbit starts"):
        frames_of(tiny_shown(), ViewRequest(camera="train:0"), "orbit", "both", 3)
