"""A camera's rotation is exact to rounding, and an exact one keeps its bits."""

from __future__ import annotations

import numpy as np
import pytest

from graings.camera.camera import Camera


def turned(angle: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = (0.5, 0.3, 4.0)
    return pose


@pytest.mark.parametrize("spoil", [lambda pose: pose.astype(np.float32), lambda pose: pose * ([[1 + 4.9e-5] * 4] * 4)])
def test_a_rounded_rotation_becomes_exact(spoil) -> None:  # type: ignore[no-untyped-def]
    pose = np.array(spoil(turned(0.7)), np.float64)
    pose[3] = (0, 0, 0, 1)
    camera = Camera(pose, 400.0, 400.0, 200.0, 200.0, 400, 400)
    rotation = camera.world_to_camera[:3, :3]
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-15
    np.testing.assert_allclose(rotation, turned(0.7)[:3, :3], atol=1e-6)
    np.testing.assert_allclose(rotation @ camera.center + camera.world_to_camera[:3, 3], 0, atol=1e-14)
    again = Camera(camera.world_to_camera, 400.0, 400.0, 200.0, 200.0, 400, 400)
    assert np.array_equal(again.world_to_camera, camera.world_to_camera)


def test_an_exact_pose_keeps_its_bits() -> None:
    pose = turned(0.7)
    assert np.array_equal(Camera(pose, 1.0, 1.0, 0.0, 0.0, 1, 1).world_to_camera, pose)


def test_points_are_projected_as_the_docstring_says() -> None:
    camera = Camera.orbit(30.0, 20.0, 3.0, fov=0.8, width=60, height=40)
    points = np.random.default_rng(0).normal(size=(20, 3))
    pixels, depths = camera.project(points)
    for point, pixel, depth in zip(points, pixels, depths, strict=True):
        x, y, z, _ = camera.world_to_camera @ [*point, 1.0]
        np.testing.assert_allclose(pixel, (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), rtol=1e-12)
        assert depth == pytest.approx(z, rel=1e-12)
    behind = camera.center - camera.forward
    pixels, depths = camera.project(np.stack([behind, camera.center]))
    assert np.isfinite(pixels).all()
    np.testing.assert_allclose(depths, [-1.0, 0.0], atol=1e-12)
