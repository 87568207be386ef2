"""`poses_bounds.npy` of LLFF and Neural-3D-Video."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.errors import CaptureError
from tests.capture.captures import orbit, pixels, write_image

SIZE = (32, 20)


def row(camera: Camera, factor: float = 1.0) -> NDArray[np.float64]:
    """A pose for images `factor` times as large: down, right and backward axis, centre, and height, width, focal."""
    right, down, forward = camera.world_to_camera[:3, :3]
    intrinsics = factor * np.array([camera.height, camera.width, camera.fx])
    return np.concatenate([np.stack([down, right, -forward, camera.center, intrinsics], axis=1).ravel(), [0.5, 9.0]])


def write_poses(folder: Path, count: int = 10, factor: float = 1.0) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "poses_bounds.npy", [row(orbit(index, count, SIZE), factor) for index in range(count)])
    return folder


def write_llff(folder: Path, images: str = "images", factor: float = 1.0) -> Path:
    for index in range(10):
        write_image(folder / images / f"IMG_{index:04d}.JPG", pixels(SIZE[1], SIZE[0], 3, seed=index))
    return write_poses(folder, factor=factor)


def write_rig(folder: Path, place: str = "cam{:02d}/images") -> Path:
    for camera in range(10):
        for time in range(3):
            name = f"{place.format(camera)}/{time:04d}.png"
            write_image(folder / name, pixels(SIZE[1], SIZE[0], 3, seed=10 * camera + time))
    return write_poses(folder)


def check_camera(found: Camera, index: int, world_to_camera: NDArray[np.float64]) -> None:
    expected = orbit(index, 10, SIZE)
    np.testing.assert_allclose(world_to_camera, expected.world_to_camera, atol=1e-12)
    assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx((expected.fx, expected.fx, 16.0, 10.0))


@pytest.mark.parametrize(("images", "factor"), [("images", 1.0), ("images_4", 4.0), ("images_8", 8.0)])
def test_poses_belong_to_the_pictures_in_the_order_of_their_names(tmp_path: Path, images: str, factor: float) -> None:
    capture = load_capture(write_llff(tmp_path, images, factor))
    assert capture.kind == "llff"
    assert capture.times.tolist() == [0.0]
    for _, frame in capture:
        check_camera(frame.camera, int(frame.name[-8:-4]), capture.units.camera_back(frame.camera))


@pytest.mark.parametrize("place", ["cam{:02d}/images", "cam{:02d}", "images/cam{:02d}"])
def test_poses_belong_to_the_folders_of_a_rig(tmp_path: Path, place: str) -> None:
    capture = load_capture(write_rig(tmp_path, place))
    assert capture.times.tolist() == [0.0, 0.5, 1.0]
    assert (len(capture.train), len(capture.val), len(capture.test)) == (21, 3, 6)  # whole cameras
    for _, frame in capture:
        camera = int(frame.name.split("cam")[1][:2])
        check_camera(frame.camera, camera, capture.units.camera_back(frame.camera))


@pytest.mark.parametrize("rig", [False, True])
def test_one_pose_belongs_to_all_pictures_of_a_still_camera(tmp_path: Path, rig: bool) -> None:
    for time in range(12):
        write_image(tmp_path / f"images/{time:04d}.png", pixels(SIZE[1], SIZE[0], 3, seed=time))
    capture = load_capture(write_poses(tmp_path, count=1), CaptureConfig(rig=rig))
    assert sum(len(capture.split(split)) for split in ("train", "val", "test")) == 12


def test_with_the_option_the_folders_of_a_rig_are_read_beside_the_calibrated_pictures(tmp_path: Path) -> None:
    write_llff(tmp_path)
    write_rig(tmp_path)
    assert sum(len(load_capture(tmp_path).split(split)) for split in ("train", "val", "test")) == 10
    capture = load_capture(tmp_path, CaptureConfig(rig=True))
    assert (len(capture.train), len(capture.val), len(capture.test)) == (21, 3, 6)
    assert capture.times.tolist() == [0.0, 0.5, 1.0]


def test_the_option_for_a_rig_without_folders_of_frames_is_refused(tmp_path: Path) -> None:
    write_llff(tmp_path)
    with pytest.raises(CaptureError, match=r"^poses_bounds\.npy: gives 10 poses.* and no 10 folders of frames"):
        load_capture(tmp_path, CaptureConfig(rig=True))


def test_videos_are_refused_with_the_command_that_extracts_their_frames(tmp_path: Path) -> None:
    write_poses(tmp_path)
    for camera in range(10):
        (tmp_path / f"cam{camera:02d}.mp4").write_bytes(b"")
    with pytest.raises(CaptureError, match=r"videos cam00\.mp4, .* whose frames are not extracted") as caught:
        load_capture(tmp_path)
    assert "ffmpeg -i cam00.mp4 cam00/%05d.png" in caught.value.remedy


def test_another_number_of_pictures_is_refused(tmp_path: Path) -> None:
    (write_llff(tmp_path) / "images/IMG_0003.JPG").unlink()
    with pytest.raises(CaptureError, match=r"^poses_bounds\.npy: gives 10 poses, but there are 9 in images"):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows.__setitem__((2, slice(0, 15, 5)), 0.0), r"row 2: is no pose"),
        (lambda rows: rows.__setitem__((2, 3), np.nan), r"row 2: is no pose"),
        (lambda rows: rows.__setitem__((2, 14), -5.0), r"row 2: is no pose"),
        (lambda rows: rows.__setitem__((2, 4), 32.0), r"row 2: is for 32x32 px, the image images/IMG_0002\.JPG"),
    ],
)
def test_broken_poses_are_refused(tmp_path: Path, change: Any, message: str) -> None:
    write_llff(tmp_path)
    rows = np.load(tmp_path / "poses_bounds.npy")
    change(rows)
    np.save(tmp_path / "poses_bounds.npy", rows)
    with pytest.raises(CaptureError, match=rf"^poses_bounds\.npy, {message}"):
        load_capture(tmp_path)


def test_times_of_still_pictures_come_from_their_names_when_asked(tmp_path: Path) -> None:
    capture = load_capture(write_llff(tmp_path), CaptureConfig(times_from_names=True))
    assert len({frame.time for _, frame in capture}) == 10
