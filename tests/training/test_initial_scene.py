"""The initial scene: voxel size, and triangulated points where the masks cover the images."""

from __future__ import annotations

import copy
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graings.camera.camera import Camera
from graings.capture.capture import Capture, Frame
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from graings.random import RandomStreams
from graings.training.initialization.initial_scene import (
    VOXEL_PER_PIXEL,
    InitialPoints,
    InitialScene,
    initial_points,
    make_scene,
)
from graings.training.initialization.triangulation import triangulate
from tests.capture.captures import FOV, write_image, write_walled
from tests.training.micro import GROWING, events_of, micro_trainer, quality, steps

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return load_capture(write_synthetic(tmp_path_factory.mktemp("capture"), seed=1, frames=20, size=40))


def _start(capture: Capture, **options: float) -> InitialScene:
    config = make_config("draft", {"init.min_mask_fraction": 0.0, "init.points": 1_000, **options})
    return make_scene(capture, ImageStore(WHITE), config, RandomStreams(0))


def _magnified(frame: Frame, times: float) -> Frame:
    camera = frame.camera
    return replace(frame, camera=replace(camera, fx=times * camera.fx, fy=times * camera.fy))


def test_the_voxel_size_is_a_share_of_a_pixel_at_the_centre(capture: Capture) -> None:
    camera = capture.train[0].camera
    pixel = float((camera.center**2).sum() ** 0.5) / camera.fx
    assert _start(capture).voxel_size == pytest.approx(VOXEL_PER_PIXEL * pixel, rel=1e-6)


def test_the_voxel_size_follows_the_near_views_but_not_a_single_close_up(capture: Capture) -> None:
    usual = _start(capture).voxel_size
    for count, share in ((1, 1.0), (7, 1 / 3)):
        frames = [_magnified(frame, 3.0 if i < count else 1.0) for i, frame in enumerate(capture.train)]
        mixed = replace(capture, train=tuple(frames))
        assert _start(mixed).voxel_size == pytest.approx(share * usual, rel=1e-6)


def test_a_camera_inside_the_content_does_not_shrink_the_voxels_without_bound(capture: Capture) -> None:
    frames = []
    for frame in capture.train:
        pose = frame.camera.world_to_camera.copy()
        pose[:3, 3] *= 1e-6
        frames.append(replace(frame, camera=replace(frame.camera, world_to_camera=pose)))
    start = _start(replace(capture, train=tuple(frames)), **{"init.points": 20_000})
    assert start.voxel_size == pytest.approx(
        VOXEL_PER_PIXEL * float(start.scene.extent) / capture.train[0].camera.fx, rel=0.05
    )


def test_a_configured_voxel_size_is_used_unchanged(capture: Capture) -> None:
    assert _start(capture, **{"init.voxel_size": 0.0625}).voxel_size == 0.0625


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Photographs that show something everywhere, without a cloud."""
    cameras = [Camera.orbit(10.0 * i, 50.0, 4.0, fov=FOV, width=64, height=64) for i in range(16)]
    return load_capture(write_walled(tmp_path_factory.mktemp("filled"), cameras))


def _first(capture: Capture, **options: object) -> InitialPoints:
    return initial_points(capture, ImageStore(WHITE), make_config("draft", options), RandomStreams(0))


def test_images_without_background_begin_with_triangulated_points(filled: Capture) -> None:
    found = triangulate(filled.train, ImageStore(WHITE))
    expected = np.concatenate([found.points, found.filled])
    first = _first(filled)
    np.testing.assert_array_equal(first.positions, expected)
    (event,) = first.notes
    assert (event.source, event.triangulated) == ("triangulation", len(found.points))
    assert event.interpolated == len(found.filled)
    for option in ("init.max_points", "density.max_anchors"):
        few = _first(filled, **{option: 100}).positions
        assert len(few) == 100
        assert {tuple(place) for place in few.tolist()} < {tuple(place) for place in expected.tolist()}


def test_cameras_that_look_outwards_get_triangulated_points(tmp_path: Path) -> None:
    cameras = []
    for angle in np.radians(np.arange(0.0, 360.0, 15.0)):
        x, y = math.cos(angle), math.sin(angle)
        cameras.append(Camera.look_at((x, y, 2.0), (3 * x, 3 * y, 0.0), fov=FOV, width=64, height=64))
    capture = load_capture(write_walled(tmp_path, cameras))
    assert any("look outwards" in note for note in capture.notes)
    assert [event.source for event in _first(capture).notes] == ["triangulation"]


@pytest.mark.parametrize("masked", [0, 20, 40])
def test_masked_pixels_do_not_make_a_room_an_object_before_a_background(
    filled: Capture, tmp_path: Path, masked: int
) -> None:
    mask = np.full((64, 64, 1), 255, np.uint8)
    mask[:, :masked] = 0
    file = write_image(tmp_path / "mask.png", mask)
    train = tuple(replace(frame, mask_path=file) for frame in filled.train)
    notes = _first(replace(filled, train=train)).notes
    assert notes[0].triangulated is not None  # it was tried, however few points are left


def test_random_points_can_be_requested(filled: Capture) -> None:
    first = _first(filled, **{"init.min_mask_fraction": 0.0, "init.points": 1_000})
    assert (len(first.positions), first.notes) == (1_000, ())


def test_too_few_triangulated_points_fall_back_to_random_ones(tmp_path: Path) -> None:
    still = [Camera.orbit(30.0, 50.0, 4.0, fov=FOV, width=64, height=64)] * 3
    first = _first(load_capture(write_walled(tmp_path, still)), **{"init.points": 1_000})
    assert 500 < len(first.positions) < 1_000  # those that the camera sees
    assert [(event.source, event.triangulated) for event in first.notes] == [("random", 0)]


def test_without_pycolmap_the_event_names_what_to_install(
    filled: Capture, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    first = _first(filled)
    assert len(first.positions) == 6_000
    assert "graings[colmap]" in first.notes[0].message
    assert _first(capture).notes == ()  # objects on a background are carved without it


def test_resuming_does_not_depend_on_finding_the_same_initial_points(
    filled: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    unbroken = micro_trainer(filled.root)
    steps(unbroken, 3)
    scene, (tensors, facts) = copy.deepcopy(unbroken.scene), unbroken.state()
    tensors = {name: values.clone() for name, values in tensors.items()}
    monkeypatch.setitem(sys.modules, "pycolmap", None)  # as on a machine without it: other points
    resumed = micro_trainer(filled.root)
    assert float(resumed.scene.extent) != float(unbroken.scene.extent)
    resumed.load(scene, tensors, facts)
    assert [r.loss for r in steps(resumed, 3)] == [r.loss for r in steps(unbroken, 3)]
    assert resumed.scene.sampling == unbroken.scene.sampling


@pytest.mark.slow(reason="compares the quality of two trainings of 300 steps")
def test_triangulated_points_improve_quality(filled: Capture) -> None:
    found = []
    for options in ({}, {"init.min_mask_fraction": 0.0, "init.points": 600}):
        trainer = micro_trainer(filled.root, iterations=300, **{"density.max_anchors": 600}, **GROWING, **options)
        reports = steps(trainer, 300)
        assert len(events_of(reports[:1], "initial_points")) == (0 if options else 1)
        assert events_of(reports[1:], "initial_points") == []
        found.append(quality(trainer))
    print(f"{found[0]:.2f} dB, from random points {found[1]:.2f} dB")
    assert found[0] > found[1] + 2
