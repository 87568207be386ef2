"""What training starts with: the size of the finest cells follows the views that look closely."""

from __future__ import annotations

from dataclasses import replace

import pytest

from graings.capture.capture import Capture, Frame
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from graings.training.initialize import VOXEL_PER_PIXEL, Start, make_scene
from graings.training.streams import Streams

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return load_capture(write_synthetic(tmp_path_factory.mktemp("capture"), seed=1, frames=20, size=40))


def _start(capture: Capture, **options: float) -> Start:
    config = make_config("draft", {"init.carve_vote": 0.0, "init.points": 1_000, **options})
    return make_scene(capture, ImageStore(WHITE), config, Streams(0))


def _magnified(frame: Frame, times: float) -> Frame:
    camera = frame.camera
    return replace(frame, camera=replace(camera, fx=times * camera.fx, fy=times * camera.fy))


def test_the_finest_cell_is_a_share_of_a_pixel_at_the_centre(capture: Capture) -> None:
    camera = capture.train[0].camera
    pixel = float((camera.center**2).sum() ** 0.5) / camera.fx
    assert _start(capture).voxel_size == pytest.approx(VOXEL_PER_PIXEL * pixel, rel=1e-6)


def test_the_finest_cell_follows_the_near_views_and_not_a_single_one(capture: Capture) -> None:
    usual = _start(capture).voxel_size
    for count, share in ((1, 1.0), (7, 1 / 3)):
        frames = [_magnified(frame, 3.0 if i < count else 1.0) for i, frame in enumerate(capture.train)]
        mixed = replace(capture, train=tuple(frames))
        assert _start(mixed).voxel_size == pytest.approx(share * usual, rel=1e-6)


def test_a_camera_amid_the_content_does_not_ask_for_ever_finer_cells(capture: Capture) -> None:
    frames = []
    for frame in capture.train:
        pose = frame.camera.world_to_camera.copy()
        pose[:3, 3] *= 1e-6
        frames.append(replace(frame, camera=replace(frame.camera, world_to_camera=pose)))
    start = _start(replace(capture, train=tuple(frames)), **{"init.points": 20_000})
    assert start.voxel_size == pytest.approx(
        VOXEL_PER_PIXEL * float(start.scene.extent) / capture.train[0].camera.fx, rel=0.05
    )


def test_a_configured_cell_is_taken_as_it_is(capture: Capture) -> None:
    assert _start(capture, **{"init.voxel_size": 0.0625}).voxel_size == 0.0625
