"""One transforms.json for all images, as nerfstudio, instant-ngp and scanning apps write it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.errors import CaptureError
from tests.capture.captures import opengl, orbit, pixels, write_colmap, write_dnerf, write_image, write_single


def numbers(capture: Any, split: str) -> list[int]:
    """Which images a split holds."""
    return [int(frame.name[-9:-4]) for frame in capture.split(split)]


def test_images_are_held_out_by_name_as_in_a_colmap_model(tmp_path: Path) -> None:
    capture = load_capture(write_single(tmp_path))
    assert capture.kind == "transforms"
    assert numbers(capture, "test") == [0, 8, 16]
    assert numbers(capture, "val") == [5, 14]
    assert sorted([*numbers(capture, "train"), 0, 8, 16, 5, 14]) == list(range(20))
    for split, frame in capture:
        written = orbit(int(frame.name[-9:-4]), 20)
        np.testing.assert_allclose(capture.units.camera_back(frame.camera), written.world_to_camera, atol=1e-14)
        camera = frame.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60.0, 62.0, 33.0, 19.0), split
        assert frame.lens is None


def rig(folder: Path, cameras: int, instants: int, **top: Any) -> Path:
    """A rig of `cameras` fixed cameras; image i is of camera i % cameras at time i // cameras."""
    write_single(folder, cameras * instants, **top)
    document = json.loads((folder / "transforms.json").read_text())
    for frame in document["frames"]:
        number = int(frame["file_path"][-9:-4])
        frame["transform_matrix"] = opengl(orbit(number % cameras, cameras))
        frame["time"] = number // cameras
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def test_of_a_rig_whole_cameras_are_held_out(tmp_path: Path) -> None:
    capture = load_capture(rig(tmp_path, 9, 3))
    cameras = {split: {number % 9 for number in numbers(capture, split)} for split in ("train", "val", "test")}
    assert cameras == {"train": {1, 2, 3, 4, 6, 7}, "val": {5}, "test": {0, 8}}
    assert [len(capture.split(split)) for split in ("train", "val", "test")] == [18, 3, 6]
    assert "no split is given: every 8th camera by name is held out for test (6 images)" in capture.notes
    assert "every 8th of the other cameras is held out for val (3 images)" in capture.notes


def test_few_cameras_or_cameras_with_one_image_are_no_rig(tmp_path: Path) -> None:
    assert numbers(load_capture(rig(tmp_path / "few", 5, 4)), "test") == [0, 8, 16]
    assert numbers(load_capture(rig(tmp_path / "once", 20, 1)), "test") == [0, 8, 16]
    short = load_capture(rig(tmp_path / "short", 5, 4), CaptureConfig(test_every=4))
    assert {number % 5 for number in numbers(short, "test")} == {0, 4}


def test_splits_that_the_file_lists_are_used(tmp_path: Path) -> None:
    name = "images/frame_{:05d}.png".format
    write_single(
        tmp_path,
        10,
        train_filenames=[name(i) for i in (1, 2, 3, 4)],
        val_filenames=[name(6)],
        test_filenames=[name(7), f"./{name(4)}"],
    )
    capture = load_capture(tmp_path)
    assert [numbers(capture, split) for split in ("train", "val", "test")] == [[1, 2, 3, 4], [6], [4, 7]]
    assert "1 of 2 test images are also training images" in capture.notes
    assert "4 images that no split lists are not used" in capture.notes


def test_images_that_no_list_holds_out_are_trained_on(tmp_path: Path) -> None:
    capture = load_capture(write_single(tmp_path, 6, test_filenames=["images/frame_00002.png"]))
    assert [numbers(capture, split) for split in ("train", "val", "test")] == [[0, 1, 3, 4, 5], [], [2]]


def test_times_come_from_names_when_configured_and_the_file_gives_none(tmp_path: Path) -> None:
    write_single(tmp_path, 11)
    assert load_capture(tmp_path).times.tolist() == [0.0]
    capture = load_capture(tmp_path, CaptureConfig(times_from_names=True))
    assert {frame.time for _, frame in capture} == {index / 10 for index in range(11)}
    write_single(tmp_path, 11, frame={"time": 3.0})
    assert load_capture(tmp_path, CaptureConfig(times_from_names=True)).times.tolist() == [0.0]


@pytest.mark.parametrize(
    ("model", "keys", "params"),
    [
        ("OPENCV", {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002}, (-0.1, 0.02, 0.001, -0.002)),
        ("FULL_OPENCV", {"k1": -0.1, "k2": 0.02, "k3": 0.003}, (-0.1, 0.02, 0.0, 0.0, 0.003, 0.0, 0.0, 0.0)),
        ("OPENCV_FISHEYE", {"camera_model": "OPENCV_FISHEYE", "k1": 0.01}, (0.01, 0.0, 0.0, 0.0)),
        ("OPENCV_FISHEYE", {"is_fisheye": True, "k2": 0.01}, (0.0, 0.01, 0.0, 0.0)),
        ("OPENCV_FISHEYE", {"camera_model": "SIMPLE_RADIAL_FISHEYE", "k1": 0.02}, (0.02, 0.0, 0.0, 0.0)),
        ("OPENCV_FISHEYE", {"camera_model": "RADIAL_FISHEYE", "k1": 0.02, "k2": 0.01}, (0.02, 0.01, 0.0, 0.0)),
        (
            "THIN_PRISM_FISHEYE",
            {"camera_model": "THIN_PRISM_FISHEYE", "k1": 0.01, "p1": 0.001, "k3": 0.002, "sx1": 0.001},
            (0.01, 0.0, 0.001, 0.0, 0.002, 0.0, 0.001, 0.0),
        ),
        (
            "FULL_OPENCV",
            {"camera_model": "FULL_OPENCV", "k1": -0.1, "k4": 0.01, "k6": 0.002},
            (-0.1, 0.0, 0.0, 0.0, 0.0, 0.01, 0.0, 0.002),
        ),
        ("FOV", {"camera_model": "FOV", "omega": 0.3}, (0.3,)),
    ],
)
def test_distorted_lenses_are_undistorted_as_pycolmap_does(
    tmp_path: Path, model: str, keys: dict[str, Any], params: tuple[float, ...]
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    y, x = np.mgrid[:40, :64]
    smooth = np.stack([x * 3.5, y * 6.0, 255 - x - y], axis=2).astype(np.uint8)
    write_single(tmp_path, 2, **keys)
    write_image(tmp_path / "images/frame_00001.png", smooth)
    capture = load_capture(tmp_path)
    assert f"images are undistorted when decoded ({model})" in capture.notes
    frame = capture.train[0]
    lens = pycolmap.Camera(model=model, width=64, height=40, params=[60.0, 62.0, 33.0, 19.0, *params])
    image, flat = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(smooth), lens)
    assert [frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy] == list(flat.params)
    ours = ImageStore((0.0, 0.0, 0.0)).rgb(frame) * 255
    theirs = np.asarray(image.to_array(), dtype=np.float32)
    np.testing.assert_allclose(ours[1:-1, 1:-1], theirs[1:-1, 1:-1], rtol=0, atol=1.01)  # theirs has 8 bits


def test_applied_transform_changes_neither_poses_nor_points(tmp_path: Path) -> None:
    """nerfstudio stores poses and points after it: it only leads back to the axes of COLMAP."""
    applied = [[0.0, 1.0, 0.0, 3.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0]]
    plain = load_capture(write_single(tmp_path / "plain", 4))
    transformed = load_capture(write_single(tmp_path / "applied", 4, applied_transform=applied, applied_scale=0.5))
    for (_, one), (_, other) in zip(plain, transformed, strict=True):
        np.testing.assert_array_equal(one.camera.world_to_camera, other.camera.world_to_camera)


def test_intrinsics_of_frames_win_over_those_of_the_file(tmp_path: Path) -> None:
    write_single(tmp_path, 4)
    path = tmp_path / "transforms.json"
    document = json.loads(path.read_text())
    for frame in document["frames"]:
        number = int(frame["file_path"][-9:-4])
        frame.update(fl_x=50.0 + number, fl_y=40.0 + number, cx=30.0 + number)
    path.write_text(json.dumps(document))
    for _, frame in load_capture(tmp_path):
        number, camera = int(frame.name[-9:-4]), frame.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50.0 + number, 40.0 + number, 30.0 + number, 19.0)


def test_a_lens_of_the_frame_wins_over_that_of_the_file(tmp_path: Path) -> None:
    capture = load_capture(write_single(tmp_path, 4, frame={"k1": 0.0, "is_fisheye": False}, k1=-0.1, is_fisheye=True))
    assert all(frame.lens is None for _, frame in capture)


def test_an_empty_name_of_points_means_none(tmp_path: Path) -> None:
    assert load_capture(write_single(tmp_path, ply_file_path="")).points is None


def test_points_are_those_of_the_ply_file(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uint8 {color}\n" for color in ("red", "green", "blue")) + "end_header\n"
    (tmp_path / "sparse_pc.ply").write_text(header + "0 0 0.5 255 0 51\n0.25 0 0 0 0 0\nnan 0 0 1 2 3\n")
    capture = load_capture(write_single(tmp_path, ply_file_path="sparse_pc.ply"))
    assert capture.points is not None
    points = capture.units.points_back(capture.points.positions)
    np.testing.assert_allclose(points, [[0, 0, 0.5], [0.25, 0, 0]], atol=1e-15)
    np.testing.assert_array_equal(capture.points.colors, np.float32([[1, 0, 0.2], [0, 0, 0]]))
    assert "1 of 3 points are discarded: not finite or beyond 1e+15" in capture.notes


def test_files_per_split_and_colmap_models_take_precedence(tmp_path: Path) -> None:
    write_single(tmp_path, 4)
    (tmp_path / "transforms.json").write_text("not even JSON")
    write_colmap(tmp_path)
    assert load_capture(tmp_path).kind == "colmap"
    write_dnerf(tmp_path)
    assert load_capture(tmp_path).kind == "transforms"


def top(**keys: Any) -> Callable[[dict[str, Any]], Any]:
    """Set keys of the file."""
    return lambda document: document.update(keys)


BROKEN: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no frames": (top(frames=[]), r"transforms\.json, frames: has no frames"),
    "another kind of camera": (
        top(camera_model="EQUIRECTANGULAR"),
        r"transforms\.json, frames\[0\]: pictures of the camera model EQUIRECTANGULAR show all directions.*Cut each",
    ),
    "an unknown kind of camera": (
        top(camera_model="FISHEYE624"),
        r"transforms\.json, frames\[0\]: the camera model FISHEYE624 is not supported",
    ),
    "tangential fisheye": (
        top(is_fisheye=True, p1=0.1),
        r"transforms\.json, frames\[0\]: a fisheye lens with tangential distortion",
    ),
    "a lens that cannot be undistorted": (
        top(k1=-5.0),
        r"transforms\.json, frames\[0\]: the camera OPENCV .* cannot be undistorted",
    ),
    "an unknown name in a split": (
        top(val_filenames=["images/frame_00003.png", "images/other.png"]),
        r"transforms\.json, val_filenames\[1\]: 'images/other\.png' is no image of frames",
    ),
    "an image that is no frame's in a split": (
        top(val_filenames=["spare.png"]),
        r"transforms\.json, val_filenames\[0\]: 'spare\.png' is no image of frames",
    ),
    "nothing to train on": (
        top(train_filenames=[], test_filenames=["images/frame_00001.png"]),
        r"transforms\.json, train_filenames: leaves no training image",
    ),
    "points file that is missing": (top(ply_file_path="gone.ply"), r"gone\.ply: is missing"),
    "points outside": (top(ply_file_path="../gone.ply"), r"transforms\.json, ply_file_path: .*leads outside"),
    "time for some only": (
        lambda document: document["frames"][1].update(time=0.5),
        r"transforms\.json, time of images/frame_00003\.png: the time is missing here",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_file_is_refused_with_its_reason(tmp_path: Path, name: str) -> None:
    folder = write_single(tmp_path / "scene", 4)
    write_image(folder / "spare.png", pixels(40, 64, 3))
    load_capture(folder)  # valid before it is damaged
    change, message = BROKEN[name]
    document = json.loads((folder / "transforms.json").read_text())
    change(document)
    (folder / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(CaptureError, match=f"^{message}") as caught:
        load_capture(folder)
    assert caught.value.remedy


def test_name_without_a_number_is_refused_with_times_from_names(tmp_path: Path) -> None:
    write_single(tmp_path, 4)
    (tmp_path / "images/frame_00002.png").rename(tmp_path / "images/last.png")
    path = tmp_path / "transforms.json"
    path.write_text(path.read_text().replace("frame_00002", "last"))
    with pytest.raises(CaptureError, match=r"^images/last\.png, name: the file name contains no number"):
        load_capture(tmp_path, CaptureConfig(times_from_names=True))
