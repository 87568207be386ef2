"""Camera paths."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graings.camera.camera import Camera, View
from graings.camera.orbit import azimuths
from graings.camera.view_request import ViewRequest
from graings.errors import CheckpointError
from graings.export.camera_path import Moves, frames_of
from graings.export.formats import WRITERS
from graings.export.shown import Shown, open_shown
from graings.export.spline import PathKey, spline
from tests.export.models import UNITS, ring, tiny_shown
from tests.export.test_harmonics_fit import random_splats

WHITE = (1.0, 1.0, 1.0)


def test_time_runs_at_a_fixed_camera() -> None:
    frames = frames_of(tiny_shown(), ViewRequest(camera="train:3"), None, "time", 5)
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


def test_a_video_of_a_file_of_splats_goes_around_it(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(WRITERS["ply"](random_splats(50, 0), UNITS))
    shown = open_shown(tmp_path / "a.ply")
    for request in (ViewRequest(), ViewRequest(width=64)):
        frames = frames_of(shown, request, None, "both", 36)
        angles = azimuths(np.stack([camera.center for camera, _ in frames]), shown.units.up)
        turns = np.remainder(np.diff(np.append(angles, angles[0])) + 180.0, 360.0) - 180.0
        np.testing.assert_allclose(turns, 10.0, atol=1e-6)


def test_a_spline_passes_through_its_keys() -> None:
    keys = [PathKey(camera, time) for camera, time in zip(ring(4), (0.0, 0.2, 0.9, 1.0), strict=True)]
    found = spline(keys, 10)
    for index, key in enumerate(keys):
        np.testing.assert_allclose(found[3 * index].camera.world_to_camera, key.camera.world_to_camera, atol=1e-9)
        assert found[3 * index].time == pytest.approx(key.time)
    closed = spline(keys, 8, closed=True)
    np.testing.assert_allclose(closed[6].camera.world_to_camera, keys[3].camera.world_to_camera, atol=1e-9)
    assert [key.time for key in closed] == pytest.approx([0.0, 0.1, 0.2, 0.55, 0.9, 0.95, 1.0, 0.5])


def test_a_spline_through_views_of_different_shapes_keeps_pixels_square() -> None:
    wide, high, square = ((80, 60), (60, 80), (70, 70))
    cameras = [
        replace(camera, fx=90.0, fy=90.0, cx=0.5 * width, cy=0.5 * height, width=width, height=height)
        for camera, (width, height) in zip(ring(3), (wide, high, square), strict=True)
    ]
    for key in spline([PathKey(camera, None) for camera in cameras], 13):
        assert (key.camera.width, key.camera.height) == wide
        assert key.camera.fy == pytest.approx(key.camera.fx)


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


def nerfstudio(**frame: object) -> str:
    """A file with one frame."""
    whole = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50, **frame}
    return json.dumps({"camera_path": [whole], "render_width": 4, "render_height": 4})


@pytest.mark.parametrize(("time", "used"), [(-0.5, 0.0), (0.25, 0.25), (3.5, 1.0), (7, 1.0)])
def test_a_time_of_nerfstudio_is_clamped_as_every_other(time: float, used: float, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(nerfstudio(render_time=time))
    ((_, found),) = frames_of(tiny_shown(), ViewRequest(), str(tmp_path / "a.json"), "both", 3)
    assert found == used


@pytest.mark.parametrize("value", [7, 7.5, True, "many", [1, 2], [[1.0] * 4] * 4, {"a": 1}, [None]])
@pytest.mark.parametrize(
    "key", ["camera", "azimuth", "elevation", "radius", "target", "fov", "pose", "width", "height", "t"]
)
def test_a_value_of_any_type_in_a_key_is_used_or_refused_with_the_names_of_both(
    key: str, value: object, tmp_path: Path
) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"keys": [{}, {key: value}]}))
    numbers = ("azimuth", "elevation", "radius", "fov")
    fits = (type(value) is int and key in (*numbers, "width", "height")) or (type(value) is float and key in numbers)
    if fits:
        assert len(frames_of(tiny_shown(), ViewRequest(), str(tmp_path / "a.json"), "both", 3)) == 3
        return
    with pytest.raises(CheckpointError, match=rf"a\.json: .*(keys\[1\].* {key}|t for every key)"):
        frames_of(tiny_shown(), ViewRequest(), str(tmp_path / "a.json"), "both", 3)


@pytest.mark.parametrize("entry", [None, 3, "train:0", [], [[1, 2]], True])
def test_a_key_or_frame_that_is_no_object_is_refused_with_its_number(entry: object, tmp_path: Path) -> None:
    path = {"camera_path": [entry], "render_width": 4, "render_height": 4}
    for document, name in (({"keys": [{}, entry]}, r"keys\[1\]"), (path, r"camera_path\[0\]")):
        (tmp_path / "a.json").write_text(json.dumps(document))
        with pytest.raises(CheckpointError, match=name):
            frames_of(tiny_shown(), ViewRequest(), str(tmp_path / "a.json"), "both", 3)


def test_a_value_of_null_in_a_key_stands_for_the_default(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"keys": [{"azimuth": 10, "t": null, "camera": null, "pose": null}]}')
    frames = frames_of(tiny_shown(), ViewRequest(), str(tmp_path / "a.json"), "both", 3)
    assert [time for _, time in frames] == [0.0, 0.5, 1.0]


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
        (
            '{"camera_path": [{"fov": 50}], "render_width": 4, "render_height": 4}',
            r"camera_path\[0\] has no camera_to_world",
        ),
        ('{"camera_path": 3, "render_width": 4, "render_height": 4}', "list of frames"),
        ('{"camera_path": [{}], "render_width": 4}', "render_height must be a finite number"),
        ('{"keys": [{"azimuth": 3}], "closed": "no"}', "closed must be true or false"),
        ('{"keys": [{"t": NaN}]}', r"keys\[0\]: t must be a finite number"),
        (nerfstudio(render_time=math.nan), r"camera_path\[0\]: render_time must be a finite number"),
        (nerfstudio(render_time=math.inf), "render_time"),
        (nerfstudio(render_time="late"), "render_time"),
        (nerfstudio(fov="wide"), "fov must be a finite number"),
        (json.dumps(json.loads(nerfstudio()) | {"camera_type": "equirectangular"}), "camera_type must be perspective"),
        (nerfstudio(fov=180), r"camera_path\[0\]: fov must lie between"),
        (nerfstudio(camera_to_world=[0.0] * 16), r"camera_path\[0\]: camera_to_world is no pose"),
        (nerfstudio(camera_to_world={"a": 1}), r"camera_path\[0\]: camera_to_world is no pose"),
        (nerfstudio(camera_to_world=[math.nan] * 16), r"camera_path\[0\]: camera_to_world is no pose"),
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


@pytest.mark.parametrize(
    ("request_", "path", "moves", "message"),
    [
        (ViewRequest(), "orbit", "time", "path is for a camera that moves"),
        (ViewRequest(), "views", "time", "path is for a camera that moves"),
        (ViewRequest(), {"keys": [{}]}, "time", "path is for a camera that moves"),
        (ViewRequest(t=0.5), None, "time", "t is the time while only the camera moves"),
        (ViewRequest(t=0.5), None, "both", "t is the time while only the camera moves"),
        *(
            (ViewRequest(**{name: value}), path, "both", rf"path has its own viewpoints, so {name} ")  # type: ignore[arg-type]
            for name, value in (
                ("camera", "train:0"),
                ("azimuth", 3.0),
                ("elevation", 3.0),
                ("radius", 3.0),
                ("target", (0.0, 0.0, 0.0)),
                ("fov", 40.0),
            )
            for path in ("views", {"keys": [{}]})
        ),
    ],
)
def test_a_value_that_would_have_no_effect_is_refused(
    request_: ViewRequest, path: Any, moves: Moves, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        frames_of(tiny_shown(), request_, path, moves, 3)
