"""The COLMAP reader, on models that pycolmap wrote."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from graings.capture.images import ImageStore
from graings.capture.lens import Lens
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from tests.capture.captures import orbit, pixels, write_colmap, write_image

pycolmap = pytest.importorskip("pycolmap")

SIZE = (128, 80)
DISTORTED = [
    ("SIMPLE_RADIAL", (120.0, 64.0, 40.0, 0.05)),
    ("OPENCV", (120.0, 124.0, 66.0, 38.0, -0.1, 0.02, 0.001, -0.002)),
    ("OPENCV_FISHEYE", (120.0, 124.0, 64.0, 40.0, 0.01, 0.0, 0.0, 0.0)),
    ("SIMPLE_FISHEYE", (120.0, 64.0, 40.0)),
]


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("where", ["sparse/0", "sparse", "."])
def test_model_is_read_as_pycolmap_wrote_it(tmp_path: Path, text: bool, where: str) -> None:
    capture = load_capture(write_colmap(tmp_path, text=text, where=where))
    assert capture.kind == "colmap"
    assert not capture.has_alpha
    reference = pycolmap.Reconstruction(str(tmp_path / where))
    by_name = {f"images/{image.name}": image for image in reference.images.values()}
    assert {frame.name for _, frame in capture} == set(by_name)
    for _, frame in capture:
        # Text models carry 17 digits; the quaternion's way back to a matrix costs a few roundings.
        expected = by_name[frame.name].cam_from_world().matrix()
        np.testing.assert_allclose(capture.units.camera_back(frame.camera)[:3], expected, atol=1e-13)
        camera = frame.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30.0, 31.0, 15.5, 10.5)
    assert capture.points is not None
    read = capture.units.points_back(capture.points.positions)
    positions = np.array([point.xyz for point in reference.points3D.values()])
    np.testing.assert_allclose(read[np.argsort(read[:, 0])], positions[np.argsort(positions[:, 0])], atol=1e-13)
    np.testing.assert_array_equal(capture.points.colors, np.tile(np.float32([1, 0.2, 0]), (40, 1)))


def test_every_eighth_image_is_test_and_another_eighth_val(tmp_path: Path) -> None:
    capture = load_capture(write_colmap(tmp_path, count=20))
    number = {split: [int(f.name[-8:-4]) // 10 for f in capture.split(split)] for split in ("train", "val", "test")}
    assert number["test"] == [0, 8, 16]
    assert number["val"] == [5, 14]
    assert sorted(number["train"] + number["val"] + number["test"]) == list(range(20))


def test_listed_test_images_are_held_out(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "sparse/0/test.txt").write_text("frame_0030.png\nframe_0070.png\n")
    capture = load_capture(tmp_path)
    assert [frame.name for frame in capture.test] == ["images/frame_0030.png", "images/frame_0070.png"]


def test_without_times_the_scene_is_static(tmp_path: Path) -> None:
    assert load_capture(write_colmap(tmp_path)).times.tolist() == [0.0]


def test_times_come_from_their_file(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "times.json").write_text(json.dumps({f"frame_{10 * i:04d}.png": 100.0 + i * i for i in range(10)}))
    times = {frame.name: frame.time for _, frame in load_capture(tmp_path)}
    assert times["images/frame_0030.png"] == pytest.approx(9 / 81, abs=1e-15)


def test_times_come_from_names_when_configured(tmp_path: Path) -> None:
    capture = load_capture(write_colmap(tmp_path), CaptureConfig(times_from_names=True))
    times = {frame.name: frame.time for _, frame in capture}
    assert times["images/frame_0030.png"] == pytest.approx(3 / 9, abs=1e-15)
    assert capture.units.time_span == 90.0


def test_pinhole_images_are_not_resampled(tmp_path: Path) -> None:
    capture = load_capture(write_colmap(tmp_path, model="SIMPLE_RADIAL", params=(30.0, 16.0, 10.0, 0.0)))
    assert any(note.startswith("images are not undistorted") for note in capture.notes)
    frame = next(frame for _, frame in capture if frame.name.endswith("0030.png"))
    assert frame.lens is None
    expected = pixels(20, 32, 3, seed=3).astype(np.float32) / np.float32(255)
    np.testing.assert_array_equal(ImageStore((1.0, 1.0, 1.0)).rgb(frame), expected)


@pytest.mark.parametrize(("model", "params"), DISTORTED)
def test_undistortion_agrees_with_pycolmap(tmp_path: Path, model: str, params: tuple[float, ...]) -> None:
    # An image without detail finer than a pixel, because pycolmap may interpolate in 8 bit.
    y, x = np.mgrid[:80, :128]
    smooth = np.stack([x * 1.9, y * 3.0, 255 - x - y], axis=2).astype(np.uint8)
    write_colmap(tmp_path, count=2, model=model, params=params, size=SIZE)
    write_image(tmp_path / "images/frame_0010.png", smooth)
    frame = load_capture(tmp_path).train[0]
    assert frame.name == "images/frame_0010.png"
    camera = pycolmap.Camera(model=model, width=128, height=80, params=list(params))
    image, flat = pycolmap.undistort_image(
        pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(smooth), camera
    )
    assert [frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy] == list(flat.params)
    ours = ImageStore((0.0, 0.0, 0.0)).rgb(frame) * 255
    theirs = np.asarray(image.to_array(), dtype=np.float32)
    assert ours.shape == theirs.shape
    # Theirs is rounded or truncated to 8 bit: equal within one grey level wherever both sample inside the photo.
    np.testing.assert_allclose(ours[1:-1, 1:-1], theirs[1:-1, 1:-1], rtol=0, atol=1.01)


def test_undistorted_pixels_and_source_pixels_have_the_same_rays() -> None:
    lens = Lens.of(*DISTORTED[1], SIZE, DISTORTED[1][1][4:])
    assert lens is not None
    positions = lens.source_pixels()
    fx, fy, cx, cy = lens.pinhole
    camera = pycolmap.Camera(model=lens.model, width=SIZE[0], height=SIZE[1], params=list(lens.params))
    for column, row in ((0, 0), (27, 13), (80, 44)):
        ray = camera.cam_from_img(positions[row, column])
        np.testing.assert_allclose(ray * (fx, fy) + (cx, cy), (column + 0.5, row + 0.5), atol=1e-6)


def test_cameras_follow_images_that_were_scaled_down(tmp_path: Path) -> None:
    write_colmap(tmp_path, size=(64, 40), params=(60.0, 62.0, 31.0, 21.0))
    for index, path in enumerate(sorted((tmp_path / "images").iterdir())):
        write_image(path, pixels(20, 32, 3, seed=index))
    capture = load_capture(tmp_path)
    camera = capture.train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (30, 31, 15.5, 10.5, 32, 20)
    assert "the model's cameras were scaled to the size of 10 image files" in capture.notes


def test_points_that_are_not_finite_are_discarded(tmp_path: Path) -> None:
    write_colmap(tmp_path, text=True)
    path = tmp_path / "sparse/0/points3D.txt"
    path.write_text(path.read_text() + "99 nan 0 0 1 2 3 0\n98 1e300 0 0 1 2 3 0\n")
    path.write_text("\n".join(line for line in path.read_text().splitlines() if not line.startswith("#")))
    capture = load_capture(tmp_path)
    assert capture.points is not None
    assert len(capture.points.positions) == 40
    assert any(note.startswith("2 of 42 points") for note in capture.notes)


def test_model_without_points_is_centred_on_its_cameras(tmp_path: Path) -> None:
    capture = load_capture(write_colmap(tmp_path, points=0))
    assert capture.points is None
    np.testing.assert_allclose(capture.units.center, orbit(0, 1).center * 0, atol=1e-13)
