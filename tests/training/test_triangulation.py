"""Triangulation of points from pairs of images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.matching.rays import ray_intersections
from graings.training.initialization import triangulation
from graings.training.initialization.triangulation import fill_untextured, tracks, triangulate
from tests.capture.captures import FOV, entry, write_image, write_transforms, write_walled

DISTANCE = 4.0
SIZE = 96
PIXEL = DISTANCE * FOV / SIZE  # on the scene

Array = NDArray[np.float64]


def _points(folder: Path) -> Array:
    capture = load_capture(folder)
    found = triangulate(capture.train, ImageStore((1.0, 1.0, 1.0)))
    assert len(found.filled) == 0 or len(found.points) > 0
    return capture.units.points_back(found.points)


def _cameras(azimuths: Sequence[float]) -> list[Camera]:
    return [Camera.orbit(a, 50.0, DISTANCE, fov=FOV, width=SIZE, height=SIZE) for a in azimuths]


def _written(folder: Path, cameras: Sequence[Camera], images: Sequence[NDArray[np.uint8]]) -> Path:
    frames = []
    for index, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        write_image(folder / f"train/{index:03d}.png", image)
        frames.append(entry(camera, f"train/{index:03d}", index / len(cameras)))
    write_transforms(folder, "train", frames)
    write_transforms(folder, "val", [])
    return folder


def test_triangulated_points_lie_on_the_surface(tmp_path: Path) -> None:
    points = _points(write_walled(tmp_path, _cameras(range(0, 80, 10))))
    height = np.abs(points[:, 2])
    print(f"{len(points)} points, {np.median(height):.4f} from the wall, nine of ten {np.quantile(height, 0.9):.4f}")
    assert len(points) > 150
    assert np.median(height) < 0.5 * PIXEL
    assert np.quantile(height, 0.9) < 3 * PIXEL


def test_unrelated_images_give_hardly_any_points(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    images = [random.integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8) for _ in range(8)]
    assert len(_points(_written(tmp_path, _cameras(range(0, 80, 10)), images))) < 20


def test_images_without_texture_give_no_points(tmp_path: Path) -> None:
    flat = np.full((SIZE, SIZE, 3), 128, np.uint8)
    assert _points(_written(tmp_path, _cameras([0, 10, 20]), [flat] * 3)).shape == (0, 3)


@pytest.mark.parametrize("azimuths", [[30.0], [30.0] * 4, [30.0, 31.0], [0.0, 180.0]])
def test_cameras_without_parallax_give_no_points(tmp_path: Path, azimuths: list[float]) -> None:
    assert _points(write_walled(tmp_path, _cameras(azimuths))).shape == (0, 3)


def test_long_clips_use_a_limited_number_of_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_walled(tmp_path, _cameras(range(0, 80, 10)))
    monkeypatch.setattr(triangulation, "IMAGES", 3)
    capture = load_capture(folder)
    read = []

    class Watched(ImageStore):
        def rgb(self, frame):  # type: ignore[no-untyped-def]
            read.append(frame.name)
            return super().rgb(frame)

    triangulate(capture.train, Watched((1.0, 1.0, 1.0)))
    assert read == [capture.train[index].name for index in (0, 3, 6)]


def test_filled_points_have_the_depth_of_the_nearest_point(tmp_path: Path) -> None:
    camera = _cameras([20.0])[0]
    part = SIZE / 12
    ends = np.array([[0.4 * part, 0.4 * part], [SIZE - 0.4 * part, 0.4 * part]])
    depths = np.array([2.0, 5.0])
    rays = np.column_stack([(ends - camera.cx) / camera.fx, np.ones(2)]) @ camera.world_to_camera[:3, :3]
    guessed = fill_untextured(camera, camera.center + depths[:, None] * rays)
    pixels = _pixels(camera, guessed)
    # One in the middle of each of 12 x 12 parts, but for the two corners.
    wanted = {(x, y) for x in range(12) for y in range(12)} - {(0, 0), (11, 0)}
    assert sorted(map(tuple, np.floor(pixels / part).astype(int).tolist())) == sorted(wanted)
    left = np.linalg.norm(pixels - ends[0], axis=-1) < np.linalg.norm(pixels - ends[1], axis=-1)
    np.testing.assert_allclose((guessed - camera.center) @ camera.forward, np.where(left, *depths), rtol=1e-9)
    behind = camera.center - camera.forward
    assert (
        fill_untextured(camera, np.stack([behind, behind])).shape
        == fill_untextured(camera, np.empty((0, 3))).shape
        == (0, 3)
    )


def test_large_images_are_downscaled_for_sift(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_walled(tmp_path, _cameras(range(0, 80, 10)))
    monkeypatch.setattr(triangulation, "MAX_SIFT_SIDE", 64)
    small = load_capture(folder, CaptureConfig(max_side=64))
    found, same = (triangulate(each.train, ImageStore((1.0, 1.0, 1.0))) for each in (load_capture(folder), small))
    assert len(found.points) > 100
    np.testing.assert_array_equal(found.points, same.points)


def test_rays_intersect_at_the_true_point() -> None:
    one, other = _cameras([0.0, 25.0])
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 3))
    pixels, others = (_pixels(camera, points) for camera in (one, other))
    met, found = ray_intersections(one, other, pixels, others)
    assert met.tolist() == list(range(50))
    np.testing.assert_allclose(found, points, atol=1e-9)
    # Off the line that the other ray draws in the image, the two do not intersect.
    some = others + np.where(np.arange(50) % 2 == 0, 0.0, 40.0)[:, None] * np.array([0.0, 1.0])
    met, found = ray_intersections(one, other, pixels, some)
    assert met.tolist() == list(range(0, 50, 2))
    np.testing.assert_allclose(found, points[::2], atol=1e-9)
    # These two diverge: where their lines come near each other is behind both cameras.
    apart = np.array([[0.0, 0.5 * SIZE]]), np.array([[float(SIZE), 0.5 * SIZE]])
    assert sorted(len(ray_intersections(one, other, *ends)[0]) for ends in (apart, apart[::-1])) == [0, 1]


def test_matches_that_share_a_feature_form_one_track() -> None:
    links = np.array([[0, 4, 2, 7, 5], [1, 5, 1, 8, 2]])
    assert tracks(links, 10).tolist() == [0, 0, 0, 7, 0]
    chain = np.stack([np.arange(1, 1000), np.arange(999)])[:, ::-1]
    assert not tracks(chain, 1000).any()
    assert tracks(np.empty((2, 0), np.int64), 10).shape == (0,)


def _pixels(camera: Camera, points: Array) -> Array:
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    return np.column_stack(
        [camera.fx * local[:, 0] / local[:, 2] + camera.cx, camera.fy * local[:, 1] / local[:, 2] + camera.cy]
    )
