"""Camera paths and videos."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import OpenImageIO as oiio
import pytest

from graings.camera.camera import Camera, View
from graings.camera.orbit import azimuths
from graings.camera.view_request import ViewRequest
from graings.errors import CheckpointError
from graings.export.camera_path import PathKey, frames_of, spline
from graings.export.shown import Shown
from graings.export.video import CODECS, check_video, write_video
from graings.render import PreparedScene, render
from tests.export.models import UNITS, ring, tiny_model

WHITE = (1.0, 1.0, 1.0)


def shown() -> Shown:
    model = tiny_model()
    return Shown(PreparedScene(model.scene), model.units, model.views, model.background)


def test_time_runs_at_a_fixed_camera() -> None:
    frames = frames_of(shown(), ViewRequest(camera="train:3"), "orbit", "time", 5)
    assert [time for _, time in frames] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert all(camera is frames[0][0] for camera, _ in frames)


def test_an_orbit_goes_around_once_at_a_frozen_time() -> None:
    frames = frames_of(shown(), ViewRequest(azimuth=10.0, t=0.3), "orbit", "camera", 8)
    assert [time for _, time in frames] == [0.3] * 8
    centers = np.stack([camera.center for camera, _ in frames])
    steps = np.linalg.norm(np.roll(centers, -1, axis=0) - centers, axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)  # the last frame is as far from the first as others
    assert [time for _, time in frames_of(shown(), ViewRequest(), "orbit", "both", 3)] == [0.0, 0.5, 1.0]


def test_a_path_through_views_is_smooth_closed_and_looks_at_the_scene() -> None:
    frames = frames_of(shown(), ViewRequest(), "views", "camera", 64)
    centers = np.stack([camera.center for camera, _ in frames])
    steps = np.linalg.norm(np.roll(centers, -1, axis=0) - centers, axis=1)
    assert steps.max() < 0.6  # of a way of about 15
    for camera, _ in frames:
        toward = -camera.center / np.linalg.norm(camera.center)
        assert camera.forward @ toward > math.cos(math.radians(25))


def one_sided(middle: float) -> Shown:
    """Training views over 60 degrees of azimuth."""
    whole = shown()
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
    frames = frames_of(shown(), ViewRequest(), None, "camera", 8)
    turned = frames_of(shown(), ViewRequest(), "orbit", "camera", 8)
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
    scene = shown()
    frames = frames_of(scene, ViewRequest(), str(tmp_path / "keys.json"), "both", 3)
    assert [time for _, time in frames] == [1.0, 0.5, 0.0]
    first = scene.views["train"][0].camera
    np.testing.assert_allclose(frames[0][0].world_to_camera, first.world_to_camera, atol=1e-9)
    frozen = frames_of(scene, ViewRequest(t=0.7), str(tmp_path / "keys.json"), "camera", 3)
    assert [time for _, time in frozen] == [0.7] * 3


def test_nerfstudio_files_are_followed_frame_by_frame(tmp_path: Path) -> None:
    scene = shown()
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
        frames_of(shown(), ViewRequest(), str(tmp_path / "a.json"), "both", 3)


def decoded(path: Path) -> tuple[Any, list[np.ndarray]]:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        return stream.average_rate, frames


@pytest.mark.parametrize(("suffix", "error"), [(".mp4", 6), (".webm", 8), (".gif", 12)])
def test_a_video_holds_the_rendered_frames(suffix: str, error: float, tmp_path: Path) -> None:
    scene, seen = shown(), []
    frames = frames_of(scene, ViewRequest(width=64, height=48), "orbit", "both", 6)
    write_video(tmp_path / f"a{suffix}", scene, frames, WHITE, fps=20, observe=seen.append)
    assert seen == [1, 2, 3, 4, 5, 6]
    rate, found = decoded(tmp_path / f"a{suffix}")
    assert rate == 20
    assert len(found) == 6
    for (camera, time), pixels in zip(frames, found, strict=True):
        expected = 255 * render(scene.scene, camera, time, WHITE).color.clamp(0, 1).numpy()
        assert pixels.shape == (48, 64, 3)
        assert np.abs(pixels - expected).mean() < error
    assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]


def test_an_animated_webp_has_every_frame(tmp_path: Path) -> None:
    scene = shown()
    write_video(tmp_path / "a.webp", scene, frames_of(scene, ViewRequest(), "orbit", "both", 4), WHITE)
    file = oiio.ImageInput.open(str(tmp_path / "a.webp"))
    assert file.spec().width == 40
    assert (tmp_path / "a.webp").read_bytes().count(b"ANMF") == 4


def test_a_name_without_suffix_is_a_folder_of_pictures(tmp_path: Path) -> None:
    scene = shown()
    write_video(tmp_path / "frames", scene, frames_of(scene, ViewRequest(), "orbit", "time", 3), WHITE)
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == ["00000.png", "00001.png", "00002.png"]


def test_odd_sides_lose_a_pixel_where_colour_is_subsampled(tmp_path: Path) -> None:
    scene = shown()
    frames = frames_of(scene, ViewRequest(width=33, height=21), "orbit", "time", 2)
    write_video(tmp_path / "a.mp4", scene, frames, WHITE)
    assert decoded(tmp_path / "a.mp4")[1][0].shape == (20, 32, 3)


def test_an_interrupted_video_leaves_no_file(tmp_path: Path) -> None:
    scene = shown()

    def stop(done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "a.mp4", scene, frames_of(scene, ViewRequest(), "orbit", "time", 3), WHITE, observe=stop)
    assert list(tmp_path.iterdir()) == []


def test_wrong_requests_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\.mp4, \.webm"):
        check_video(Path("a.avi"))
    with pytest.raises(ValueError, match="at least one frame"):
        frames_of(shown(), ViewRequest(), "orbit", "both", 0)
    with pytest.raises(ValueError, match="orbit starts"):
        frames_of(shown(), ViewRequest(camera="train:0"), "orbit", "both", 3)
    with pytest.raises(ValueError, match="fps"):
        write_video(tmp_path / "a.mp4", shown(), [(Camera(np.eye(4), 9, 9, 4, 4, 8, 8), 0.0)], WHITE, fps=0)
    assert set(CODECS) == {".mp4", ".webm", ".webp", ".gif"}
