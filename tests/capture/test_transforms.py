"""The transforms reader: layouts of known programs, cameras, times, splits."""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graings.capture.capture import Capture
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from tests.capture.captures import FOV, entry, orbit, pixels, write_dnerf, write_image, write_transforms

TIMES = [0.0, 0.25, 0.5, 1.0]


def one_frame(folder: Path, size: tuple[int, int] = (12, 12), *, top: dict[str, Any], **keys: Any) -> Capture:
    """A capture of one image of `size` (width, height) with `top` keys in the file and `keys` in the frame."""
    write_image(folder / "train/a.png", pixels(size[1], size[0]))
    path = folder / "transforms_train.json"
    path.write_text(json.dumps({**top, "frames": [entry(orbit(0, 1), "train/a", **keys)]}))
    return load_capture(folder, CaptureConfig(max_side=None))


@pytest.mark.parametrize("style", ["./train/r_{:03d}", "train/r_{:03d}", "./train/r_{:03d}.png", "train/r_{:03d}.png"])
def test_file_path_may_lack_extension_and_dot(tmp_path: Path, style: str) -> None:
    write_dnerf(tmp_path, TIMES)
    frames = [entry(orbit(i, 4), style.format(i), TIMES[i]) for i in range(4)]
    write_transforms(tmp_path, "train", frames)
    write_transforms(tmp_path, "val", [])
    capture = load_capture(tmp_path)
    assert [frame.name for frame in capture.train] == [f"train/r_{i:03d}.png" for i in range(4)]
    assert [frame.time for frame in capture.train] == TIMES
    assert capture.kind == "transforms"
    assert capture.has_alpha
    assert capture.val == capture.test == ()


def test_poses_become_opencv_and_keep_their_geometry(tmp_path: Path) -> None:
    capture = load_capture(write_dnerf(tmp_path))
    for index, frame in enumerate(capture.train):
        written = orbit(index, 4)
        back = capture.units.camera_back(frame.camera)
        np.testing.assert_allclose(back, written.world_to_camera, atol=1e-14)
        np.testing.assert_allclose(capture.units.points_back(frame.camera.center), written.center, atol=1e-14)


def test_missing_time_means_static(tmp_path: Path) -> None:
    capture = load_capture(write_dnerf(tmp_path))
    assert capture.times.tolist() == [0.0]
    assert capture.units.time_span == 0.0
    assert any("static" in note for note in capture.notes)


def test_focal_length_of_the_frame_wins_over_that_of_the_file(tmp_path: Path) -> None:
    capture = one_frame(tmp_path, top={"camera_angle_x": FOV}, fl_x=20.0, fl_y=21.0, cx=5.0, cy=7.0, w=12, h=12)
    camera = capture.train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (20.0, 21.0, 5.0, 7.0)


def test_angle_of_the_frame_wins_over_focal_length_of_the_file(tmp_path: Path) -> None:
    camera = one_frame(tmp_path, top={"fl_x": 99.0}, camera_angle_x=1.0).train[0].camera
    assert camera.fx == camera.fy == 6.0 / math.tan(0.5)
    assert (camera.cx, camera.cy) == (6.0, 6.0)


def test_vertical_angle_gives_its_own_focal_length(tmp_path: Path) -> None:
    camera = one_frame(tmp_path, (12, 8), top={"camera_angle_x": 1.0, "camera_angle_y": 0.5}).train[0].camera
    assert (camera.fx, camera.fy) == (6.0 / math.tan(0.5), 4.0 / math.tan(0.25))


def test_intrinsics_for_another_size_are_scaled_to_the_file(tmp_path: Path) -> None:
    camera = one_frame(tmp_path, (12, 8), top={"fl_x": 40.0, "cx": 10.0, "cy": 8.0, "w": 24, "h": 16}).train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (20.0, 20.0, 5.0, 4.0)


def test_images_of_mixed_sizes_are_reduced_each_to_the_longest_side(tmp_path: Path) -> None:
    write_dnerf(tmp_path)
    write_image(tmp_path / "train/r_000.png", pixels(40, 24))
    write_image(tmp_path / "train/r_001.png", pixels(24, 33, 3))
    capture = load_capture(tmp_path, CaptureConfig(max_side=16))
    sizes = [(frame.camera.width, frame.camera.height) for frame in capture.train]
    assert sizes == [(10, 16), (16, 12), (12, 12), (12, 12)]
    assert [frame.source_size for frame in capture.train[:2]] == [(24, 40), (33, 24)]
    camera = capture.train[0].camera
    assert camera.fx == pytest.approx(0.5 * 10 / math.tan(0.5 * FOV), rel=1e-15)
    store = ImageStore((1.0, 1.0, 1.0))
    for frame in capture.train:
        assert store.rgb(frame).shape == (frame.camera.height, frame.camera.width, 3)
    assert store.alpha(capture.train[1]) is None
    assert store.alpha(capture.train[2]) is not None


def test_three_splits_share_one_time_axis(tmp_path: Path) -> None:
    write_dnerf(tmp_path, [2.0, 3.0])
    for split, time in (("val", 1.0), ("test", 5.0)):
        write_image(tmp_path / f"{split}/a.png", pixels(12, 12))
        write_transforms(tmp_path, split, [entry(orbit(1, 3), f"./{split}/a", time)])
    capture = load_capture(tmp_path)
    assert [frame.time for _, frame in capture] == [0.25, 0.5, 0.0, 1.0]
    assert (capture.units.time_start, capture.units.time_span) == (1.0, 4.0)


def test_stray_files_of_known_datasets_are_ignored(tmp_path: Path) -> None:
    write_dnerf(tmp_path)
    plain = load_capture(tmp_path)
    (tmp_path / "train/transforms.json").write_text("not even JSON")
    (tmp_path / "train/masks").mkdir()
    (tmp_path / "train/masks/r_000.png").write_text("no image")
    assert load_capture(tmp_path).content_hash == plain.content_hash


def test_folder_that_contains_the_capture_is_accepted(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    write_dnerf(tmp_path / "scene")
    (tmp_path / "__MACOSX").mkdir()
    capture = load_capture(tmp_path)
    assert capture.root == tmp_path / "scene"
    assert capture.train[0].name == "train/r_000.png"


def test_content_hash_depends_on_contents_and_not_on_the_path(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
        write_dnerf(tmp_path / name)
    image = pixels(12, 12, seed=2)
    image[3, 4, 0] ^= 1
    write_image(tmp_path / "c/train/r_002.png", image)
    first, second, changed = (load_capture(tmp_path / name).content_hash for name in ("a", "b", "c"))
    assert len(first) == 64
    assert first == second != changed


def test_held_out_images_that_are_trained_on_are_noted(tmp_path: Path) -> None:
    write_dnerf(tmp_path)
    write_transforms(tmp_path, "val", [entry(orbit(0, 4), "train/r_000")])
    assert "1 of 1 val images are also training images" in load_capture(tmp_path).notes


def test_capture_is_loaded_without_decoding(tmp_path: Path) -> None:
    write_dnerf(tmp_path)
    capture = load_capture(tmp_path)
    (tmp_path / "train/r_000.png").unlink()
    assert len(capture.train) == 4  # only requesting the pixels of the missing file fails
    assert ImageStore((1.0, 1.0, 1.0)).rgb(capture.train[1]).shape == (12, 12, 3)


def test_unpacked_archive_is_read_as_the_folder(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    write_dnerf(tmp_path / "scene", TIMES)
    archive = tmp_path / "scene.zip"
    with zipfile.ZipFile(archive, "w") as packed:
        for path in sorted((tmp_path / "scene").rglob("*.*")):
            packed.write(path, path.relative_to(tmp_path))
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(tmp_path / "out")
    assert load_capture(tmp_path / "out").content_hash == load_capture(tmp_path / "scene").content_hash
