"""Captures as people send them: names, missing pictures, several models, other layouts. Each is read or explained."""

from __future__ import annotations

import json
import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.errors import CaptureError
from tests.capture.captures import (
    FOV,
    entry,
    orbit,
    write_colmap,
    write_dnerf,
    write_single,
    write_transforms,
)

TIMES = [0.0, 0.25, 0.5, 1.0]


def edit(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Rewrite a JSON document."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def count(folder: Path, **options: Any) -> tuple[int, int, int]:
    """Numbers of images in the splits."""
    capture = load_capture(folder, CaptureConfig(**options))
    return len(capture.train), len(capture.val), len(capture.test)


def note(folder: Path, text: str, **options: Any) -> str:
    """The only note with `text`."""
    (found,) = [each for each in load_capture(folder, CaptureConfig(**options)).notes if text in each]
    return found


@pytest.mark.parametrize(
    ("listed", "disk"),
    [
        ("images\\frame_{:05d}.png", "images/frame_{:05d}.png"),
        ("./images\\frame_{:05d}", "images/frame_{:05d}.png"),
        ("images/frame_{:05d}.png", "images/frame_{:05d}.PNG"),
        ("Images/Frame_{:05d}.png", "images/frame_{:05d}.png"),
        ("images/frame_{:05d}.jpg", "images/frame_{:05d}.png"),
        (unicodedata.normalize("NFD", "images/für_{:05d}.png"), unicodedata.normalize("NFC", "images/für_{:05d}.png")),
        ("images/frame_{:05d}.png", "images_4/frame_{:05d}.png"),
    ],
)
def test_names_are_matched_as_the_file_systems_of_people_do(tmp_path: Path, listed: str, disk: str) -> None:
    plain = load_capture(write_single(tmp_path / "plain", 6))
    folder = write_single(tmp_path / "other", 6)
    for index in range(6):
        (folder / f"images/frame_{index:05d}.png").rename(folder / "moved")
        target = folder / disk.format(index)
        target.parent.mkdir(exist_ok=True)
        (folder / "moved").rename(target)

    def rename(document: dict[str, Any]) -> None:
        for frame in document["frames"]:
            frame["file_path"] = listed.format(int(frame["file_path"][-9:-4]))

    edit(folder / "transforms.json", rename)
    capture = load_capture(folder)
    assert [frame.name for _, frame in capture] == [disk.format(int(frame.name[-9:-4])) for _, frame in plain]
    if (folder / listed.format(0)).name != (folder / disk.format(0)).stem and "\\" not in listed:
        assert "6 names are spelled differently on disk" in note(folder, "spelled")
    for one, other in zip(plain, capture, strict=True):
        np.testing.assert_array_equal(one[1].camera.world_to_camera, other[1].camera.world_to_camera)


def test_a_name_that_several_files_match_is_refused(tmp_path: Path) -> None:
    folder = write_single(tmp_path, 6)
    shutil.copy(folder / "images/frame_00002.png", folder / "images/FRAME_00002.PNG")
    (folder / "images/frame_00002.png").rename(folder / "images/Frame_00002.png")
    with pytest.raises(CaptureError, match=r"may be images/FRAME_00002\.PNG or images/Frame_00002\.png"):
        load_capture(folder)


def test_a_few_missing_pictures_are_skipped_and_named(tmp_path: Path) -> None:
    folder = write_single(tmp_path, 20)
    for index in (3, 11):
        (folder / f"images/frame_{index:05d}.png").unlink()
    assert sum(count(folder)) == 18
    found = note(folder, "missing")
    assert "2 of 20 images of transforms.json (10%) are missing and left out" in found
    assert "frame_00003.png" in found
    assert "frame_00011.png" in found


def test_many_missing_pictures_are_refused_with_the_folder_that_was_looked_in(tmp_path: Path) -> None:
    folder = write_single(tmp_path, 20)
    for index in range(5):
        (folder / f"images/frame_{index:05d}.png").unlink()
    with pytest.raises(CaptureError, match=r"missing, as are 4 more of 20; looked in the folder 'images'") as caught:
        load_capture(folder)
    assert caught.value.file == "transforms.json"


def test_missing_pictures_of_a_colmap_model_are_skipped_too(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, count=20)
    (folder / "images/frame_0030.png").unlink()
    assert sum(count(folder)) == 19
    assert "1 of 20 images of sparse/0 (5%) are missing" in note(folder, "missing")


@pytest.mark.parametrize("listed", [(3, 5), (0, 3, 5, 7)])
def test_a_missing_picture_may_be_in_the_test_list_of_a_colmap_model(tmp_path: Path, listed: tuple[int, ...]) -> None:
    folder = write_colmap(tmp_path, count=10)
    (folder / "sparse/0/test.txt").write_text("".join(f"frame_{10 * index:04d}.png\n" for index in listed))
    (folder / "images/frame_0030.png").unlink()
    capture = load_capture(folder)
    assert {frame.name for frame in capture.test} == {f"images/frame_{10 * i:04d}.png" for i in listed if i != 3}
    assert sum(count(folder)) == 9
    assert "1 of 10 images" in note(folder, "are missing and left out")


def test_a_test_list_of_a_colmap_model_without_one_picture_is_left_out_and_images_are_held_out_instead(
    tmp_path: Path,
) -> None:
    folder = write_colmap(tmp_path, count=10)
    (folder / "sparse/0/test.txt").write_text("frame_0030.png\n")
    (folder / "images/frame_0030.png").unlink()
    assert "none of its images is there" in note(folder, "sparse/0/test.txt is left out")
    assert count(folder) == (6, 1, 2)


def test_a_split_that_was_never_rendered_is_left_out_and_images_are_held_out_instead(tmp_path: Path) -> None:
    folder = write_dnerf(tmp_path, [index / 19 for index in range(20)])
    (folder / "transforms_val.json").unlink()
    write_transforms(folder, "test", [entry(orbit(i, 5), f"./test/r_{i:03d}", i / 5) for i in range(5)])
    assert "transforms_test.json is left out: none of its 5 images is there" in note(folder, "left out")
    assert count(folder) == (15, 2, 3)


def test_a_backup_beside_a_good_file_is_not_taken_for_a_split(tmp_path: Path) -> None:
    folder = write_single(tmp_path, 10)
    (folder / "transforms_backup.json").write_text('{"frames": []}')
    (folder / "transforms_old (copy).json").write_text("not even JSON")
    assert sum(count(folder)) == 10


@pytest.mark.parametrize("numbers", [(0, 1), (1, 0)])
def test_of_several_models_the_largest_is_read(tmp_path: Path, numbers: tuple[int, int]) -> None:
    small, large = (f"sparse/{number}" for number in numbers)
    write_colmap(tmp_path, count=3, where=small)
    write_colmap(tmp_path, count=12, where=large)
    assert sum(count(tmp_path)) == 12
    assert f"the model {large} with 12 images is read; not read: {small} with 3" in note(tmp_path, "not read")


@pytest.mark.parametrize("where", ["sparse/1", "colmap/sparse/0", "colmap/sparse", "colmap", "sparse", "."])
@pytest.mark.parametrize("text", [True, False])
def test_a_model_is_found_where_programs_put_it(tmp_path: Path, where: str, text: bool) -> None:
    assert sum(count(write_colmap(tmp_path, where=where, text=text))) == 10


def test_the_undistorted_copy_of_a_model_two_folders_down_is_found(tmp_path: Path) -> None:
    write_colmap(tmp_path / "scene/dense/0", where="sparse")
    for folder in (tmp_path, tmp_path / "scene", tmp_path / "scene/dense"):
        assert sum(count(folder)) == 10
    # The workspace of COLMAP keeps the model of the distorted photos, whose pictures lie elsewhere.
    shutil.copytree(tmp_path / "scene/dense/0/sparse", tmp_path / "scene/sparse/0")
    assert load_capture(tmp_path / "scene").root == tmp_path / "scene/dense/0"


def test_an_image_list_without_observation_lines_is_read_whole(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, text=True)
    whole = load_capture(folder)
    path = folder / "sparse/0/images.txt"
    lines = [line for line in path.read_text().splitlines() if line.startswith("#") or line.endswith(".png")]
    path.write_text("\n".join(lines) + "\n")
    single = load_capture(folder)
    assert [frame.name for _, frame in single] == [frame.name for _, frame in whole]
    for one, other in zip(whole, single, strict=True):
        np.testing.assert_array_equal(one[1].camera.world_to_camera, other[1].camera.world_to_camera)


def both(folder: Path, times: Callable[[int], float | None] = float) -> Path:
    """A COLMAP model and a transforms.json of the same pictures."""
    write_colmap(folder, count=12)
    frames = [entry(orbit(i, 12, (32, 20)), f"images/frame_{10 * i:04d}.png", times(i)) for i in range(12)]
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": FOV, "frames": frames}))
    return folder


def test_times_of_transforms_beside_a_colmap_model_are_taken_by_name(tmp_path: Path) -> None:
    capture = load_capture(both(tmp_path, lambda index: 100.0 - index))
    assert capture.kind == "colmap"
    assert capture.points is not None
    for _, frame in capture:
        assert frame.time == pytest.approx(1.0 - int(frame.name[-8:-4]) / 110)
    assert "times those of transforms.json" in note(tmp_path, "COLMAP")


def test_transforms_that_do_not_give_all_times_are_named(tmp_path: Path) -> None:
    both(tmp_path, lambda index: float(index) if index < 5 else None)
    assert "gives 5 of 12 images a time and is not used" in note(tmp_path, "not used")
    (tmp_path / "transforms.json").write_text("not even JSON")
    assert "cannot be used for times (invalid JSON" in note(tmp_path, "transforms.json")


@pytest.mark.parametrize("write", [write_single, write_colmap, write_dnerf])
def test_a_capture_without_times_names_the_ways_to_give_them(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    found = note(write(tmp_path), "static")
    assert "capture.times_from_names=true" in found
    assert ("times.json" if write is write_colmap else "`time` of each frame") in found


@pytest.mark.parametrize("factor", [3.5, 0.01])
def test_a_pose_with_a_uniform_scale_is_read_without_it(tmp_path: Path, factor: float) -> None:
    folder = write_dnerf(tmp_path, TIMES)

    def scale(document: dict[str, Any]) -> None:
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, :3] *= factor
            frame["transform_matrix"] = pose.tolist()

    edit(folder / "transforms_train.json", scale)
    capture = load_capture(folder)
    for index, frame in enumerate(capture.train):
        back = capture.units.camera_back(frame.camera)
        np.testing.assert_allclose(back, orbit(index, 4).world_to_camera, atol=1e-12)
    assert f"the rotation part of 4 poses of transforms_train.json scales, by {factor:g}" in note(folder, "scales")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-32"])
def test_json_in_other_encodings_is_read(tmp_path: Path, encoding: str) -> None:
    folder = write_dnerf(tmp_path, TIMES)
    path = folder / "transforms_train.json"
    path.write_bytes(path.read_text().encode(encoding))
    assert len(load_capture(folder).train) == 4


def test_json_that_is_no_text_is_refused(tmp_path: Path) -> None:
    folder = write_dnerf(tmp_path, TIMES)
    (folder / "transforms_train.json").write_bytes(b'{"frames": "\xff\xfe"}')
    with pytest.raises(CaptureError, match=r"^transforms_train\.json: is not text"):
        load_capture(folder)


PLY = (
    "ply\nformat ascii 1.0\nelement vertex 1\n"
    + "".join(f"property float {a}\n" for a in "xyz")
    + "end_header\n0 0 1\n"
)


def test_a_lone_training_file_may_list_splits_and_points(tmp_path: Path) -> None:
    folder = write_dnerf(tmp_path, [index / 19 for index in range(20)])
    (folder / "transforms_val.json").unlink()
    assert count(folder) == (15, 2, 3)
    (folder / "cloud.ply").write_text(PLY)
    edit(
        folder / "transforms_train.json", lambda d: d.update(ply_file_path="cloud.ply", test_filenames=["train/r_005"])
    )
    capture = load_capture(folder)
    assert (len(capture.train), len(capture.val), len(capture.test)) == (19, 0, 1)
    assert capture.points is not None
    np.testing.assert_allclose(capture.units.points_back(capture.points.positions), [[0, 0, 1]], atol=1e-12)


FOREIGN = {
    "opensfm/reconstruction.json": "OpenDroneMap",
    "cameras.xml": "Agisoft Metashape",
    "keyframes/corrected_cameras/1.json": "Polycam",
    "clip.MP4".lower(): "video without cameras",
    "images/0001.jpg": "pictures without cameras",
    "0001.heic": "pictures without cameras",
    "point_cloud/iteration_30000/point_cloud.ply": "trained 3D Gaussian Splatting model",
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_format_that_is_not_read_is_named_with_the_way_in(tmp_path: Path, name: str) -> None:
    file = tmp_path / "scene" / name
    file.parent.mkdir(parents=True)
    file.write_bytes(b"")
    for folder in (tmp_path, tmp_path / "scene"):
        with pytest.raises(CaptureError, match=f"holds .*{FOREIGN[name]}, which is not read") as caught:
            load_capture(folder)
        assert len(caught.value.remedy) > 20
