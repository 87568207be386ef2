"""Rendered bodies of the synthetic scene match their formulas, and its captures are read back exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graings.camera.camera import Camera
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import SyntheticScene, write_synthetic

FOV = 0.69


def test_body_is_rendered_where_its_centre_projects() -> None:
    scene = SyntheticScene.random(seed=4, bodies=1)
    for time in (0.0, 0.37, 1.0):
        camera = Camera.orbit(40.0 + 200 * time, 30.0, 4.0, fov=FOV, width=96, height=64)
        alpha = scene.image(camera, time)[..., 3]
        x, y, z = camera.world_to_camera[:3, :3] @ scene.centers(time)[0] + camera.world_to_camera[:3, 3]
        rows, columns = np.mgrid[:64, :96] + 0.5
        centroid = np.array([(alpha * columns).sum(), (alpha * rows).sum()]) / alpha.sum()
        projected = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        # The image of an ellipsoid of radius r at distance d is off its centre's projection by about
        # f (r/d)^2 tan(angle): here 135 px * 0.01 * 0.3 = 0.4 px.
        np.testing.assert_allclose(centroid, projected, atol=0.5)


def test_silhouette_of_a_ball_is_exact() -> None:
    scene = SyntheticScene.random(seed=0, bodies=1)
    (body,) = scene.bodies
    body.semi_axes[:] = 0.4
    body.phases[3] = 0.0  # no squash at t = 0
    center = body.center(0.0)
    camera = Camera.look_at(center + np.array([4.0, 0.0, 0.0]), center, fov=FOV, width=200, height=200)
    image = scene.image(camera, 0.0)
    # A ball seen along its axis is a disc of radius f r / sqrt(d^2 - r^2); with 4 x 4 samples a pixel on the border is
    # off by at most 1/4, and errors average out over the rim of 2 pi R pixels.
    radius = camera.fx * 0.4 / np.sqrt(16.0 - 0.16)
    area = np.pi * radius**2
    assert image[..., 3].sum() == pytest.approx(area, abs=0.25 * np.sqrt(2 * np.pi * radius))
    assert image[100, 100, 3] == 1.0
    assert image[0, 0].tolist() == [0.0, 0.0, 0.0, 0.0]


def test_bodies_move_rotate_deform_and_change_colour() -> None:
    scene = SyntheticScene.random(seed=0, bodies=3)
    for body in scene.bodies:
        assert np.linalg.norm(body.center(0.25) - body.center(0.75)) > 0.1
        np.testing.assert_allclose(body.rotation(0.6) @ body.rotation(0.6).T, np.eye(3), atol=1e-15)
        assert np.linalg.norm(body.rotation(1.0) - np.eye(3)) > 0.5
        ratios = np.stack([body.radii(time) / body.radii(0.0) for time in (0.25, 0.5, 0.75)])
        assert np.ptp(ratios, axis=1).max() > 0.05  # not the same factor on every axis
        pole = np.array([[0.0, 0.0, 1.0]])
        assert np.abs(body.surface(pole, pole, 0.25) - body.surface(pole, pole, 0.75)).max() > 0.02


@pytest.mark.parametrize("bodies", [2, 3, 5, 8])
def test_bodies_never_touch(bodies: int) -> None:
    for seed in range(5):
        scene = SyntheticScene.random(seed, bodies)
        for time in np.linspace(0, 1, 21):
            centers = scene.centers(time)
            reach = np.array([body.radii(time).max() for body in scene.bodies])
            gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2) - reach[:, None] - reach[None]
            assert gaps[~np.eye(bodies, dtype=bool)].min() > 0


def test_written_capture_reads_back_exactly(tmp_path: Path) -> None:
    capture = load_capture(write_synthetic(tmp_path / "scene", seed=1, frames=8, size=24, bodies=2))
    assert [len(capture.split(split)) for split in ("train", "val", "test")] == [8, 2, 2]
    assert capture.has_alpha
    assert capture.units.up == (0.0, 0.0, 1.0)
    assert (capture.units.time_start, capture.units.time_span) == (0.0, 1.0)
    np.testing.assert_allclose(capture.units.center, 0.0, atol=1e-12)
    trained = {frame.time for frame in capture.train}
    assert trained.isdisjoint(frame.time for frame in (*capture.val, *capture.test))
    scene = SyntheticScene.random(seed=1, bodies=2)
    black = ImageStore((0.0, 0.0, 0.0))
    for _, frame in capture:
        pose = capture.units.camera_back(frame.camera)
        camera = Camera(pose, *(getattr(frame.camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")))
        exact = scene.image(camera, frame.time)
        # Colour and alpha are each rounded to 8 bit; rounding of the pose in the file has no visible effect.
        np.testing.assert_allclose(black.rgb(frame), exact[..., :3] * exact[..., 3:], atol=1.01 / 255)


def test_same_seed_writes_the_same_capture_and_another_seed_another(tmp_path: Path) -> None:
    hashes = [
        load_capture(write_synthetic(tmp_path / name, seed=seed, frames=3, size=16)).content_hash
        for name, seed in (("a", 0), ("b", 0), ("c", 1))
    ]
    assert hashes[0] == hashes[1] != hashes[2]


def test_a_scene_without_bodies_or_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="bodies must be at least 1"):
        write_synthetic(tmp_path, bodies=0)
    with pytest.raises(ValueError, match="frames and size must be at least 1"):
        write_synthetic(tmp_path, frames=0)
