"""Rigs of still cameras: frames in a folder for each, with the splits and masks of the calibrated images."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from graings.capture.capture import Capture
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.errors import CaptureError
from tests.capture.captures import (
    entry,
    opengl,
    orbit,
    pixels,
    write_colmap,
    write_dnerf,
    write_image,
    write_single,
    write_transforms,
)

RIG = CaptureConfig(rig=True)


def rig(folder: Path, cameras: int = 9, times: int = 3, place: str = "{camera}") -> Path:
    """A COLMAP model of one instant and a folder of frames for each camera."""
    write_colmap(folder, count=cameras)
    for camera in range(cameras):
        for time in range(times):
            name = place.format(camera=f"frame_{10 * camera:04d}")
            write_image(folder / name / f"f{5 + time:03d}.png", pixels(20, 32, 3, seed=100 * camera + time))
    return folder


@pytest.mark.parametrize("place", ["{camera}", "images/{camera}"])
def test_a_rig_of_still_cameras_is_read_when_asked(tmp_path: Path, place: str) -> None:
    folder = rig(tmp_path, place=place)
    (found,) = [note for note in load_capture(folder).notes if "capture.rig=true" in note]
    assert "27 frames of 9 cameras" in found
    capture = load_capture(folder, RIG)
    assert (len(capture.train), len(capture.val), len(capture.test)) == (18, 3, 6)  # whole cameras are held out
    assert capture.times.tolist() == [0.0, 0.5, 1.0]
    for _, frame in capture:
        camera = int(frame.name.split("frame_")[1][:4]) // 10
        expected = orbit(camera, 9).world_to_camera
        np.testing.assert_allclose(capture.units.camera_back(frame.camera), expected, atol=1e-12)
    train, test = ({frame.name[:-9] for frame in capture.split(split)} for split in ("train", "test"))
    assert not train & test


def test_a_folder_of_frames_is_listed_once_whatever_the_number_of_its_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for index in range(12):
        write_image(tmp_path / f"images/cam00/{index:05d}.png", pixels(12, 12, seed=index))
    frames = [entry(orbit(index, 12), f"images/cam00/{index:05d}.png", index / 12) for index in range(12)]
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    listed: list[Path] = []
    iterdir = Path.iterdir

    def counted(path: Path) -> Iterator[Path]:
        listed.append(path)
        return iterdir(path)

    monkeypatch.setattr(Path, "iterdir", counted)
    load_capture(tmp_path)
    assert listed.count(tmp_path / "images/cam00") == 1


def test_a_rig_without_the_frames_of_a_camera_names_it(tmp_path: Path) -> None:
    shutil.rmtree(rig(tmp_path) / "frame_0030")
    with pytest.raises(CaptureError, match=r"the camera frame_0030\.png has no folder of frames"):
        load_capture(tmp_path, RIG)


def test_a_rig_of_a_transforms_file_is_read_too(tmp_path: Path) -> None:
    capture = load_capture(transforms_rig(tmp_path), RIG)
    assert (len(capture.train), len(capture.val), len(capture.test)) == (12, 2, 4)
    poses = {int(frame.name[6:11]): frame.camera for _, frame in capture}
    assert opengl(poses[0]) != opengl(poses[1])


@pytest.mark.parametrize("files", ["one", "a split each"])
def test_frames_that_are_all_listed_are_not_read_as_a_rig(tmp_path: Path, files: str) -> None:
    """Each listed image has its own pose; the folder of one is that of the others."""
    names = [f"./images/cam/{index:03d}" for index in range(6)]
    entries = [entry(orbit(index, 6), name, index / 5) for index, name in enumerate(names)]
    for index, name in enumerate(names):
        write_image(tmp_path / f"{name}.png", pixels(20, 32, 3, seed=index))
    write_transforms(tmp_path, "train", entries[:4])
    if files == "a split each":
        write_transforms(tmp_path, "test", entries[4:])
    assert sum(len(load_capture(tmp_path).split(split)) for split in ("train", "val", "test")) == (
        4 if files == "one" else 6
    )
    with pytest.raises(CaptureError, match="lie in one folder: not a camera each") as caught:
        load_capture(tmp_path, RIG)
    assert caught.value.remedy == "Set capture.rig=false."


def transforms_rig(folder: Path, place: str = "frame_{:05d}", **top: object) -> Path:
    """A transforms file of one instant and two frames for each of its nine cameras."""
    write_single(folder, 9, **top)
    for camera in range(9):
        for time in range(2):
            write_image(folder / place.format(camera) / f"{time}.png", pixels(40, 64, 3, seed=10 * camera + time))
    return folder


def held_out(capture: Capture, split: str = "test") -> set[str]:
    return {frame.name for frame in capture.split(split)}


def of_cameras(*cameras: str, times: int = 3) -> set[str]:
    return {f"{camera}/f{5 + time:03d}.png" for camera in cameras for time in range(times)}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("listed", ["frame_0000.png", "frame_0000/f005.png frame_0000/f006.png frame_0000/f007.png"])
def test_a_test_list_of_a_rig_names_cameras_or_frames(tmp_path: Path, listed: str, encoding: str) -> None:
    folder = rig(tmp_path)
    (folder / "test.txt").write_text("\n".join([*listed.split(), "frame_0070.png", ""]), encoding=encoding)
    capture = load_capture(folder, RIG)
    assert held_out(capture) == of_cameras("frame_0000", "frame_0070")
    assert held_out(capture) & held_out(capture, "train") == set()
    assert sum(len(capture.split(split)) for split in ("train", "val", "test")) == 27


@pytest.mark.parametrize("cameras", [2, 7, 8])
def test_cameras_are_held_out_as_a_whole_from_eight_on_or_where_a_list_names_them(tmp_path: Path, cameras: int) -> None:
    """What docs/captures.md promises: below eight cameras without a list, every camera is trained on."""
    folder = rig(tmp_path, cameras=cameras, times=8)
    names = {f"frame_{10 * camera:04d}" for camera in range(cameras)}
    capture = load_capture(folder, RIG)
    trained, tested = ({Path(name).parent.name for name in held_out(capture, split)} for split in ("train", "test"))
    assert (trained == names) == (cameras < 8)
    assert tested
    assert bool(tested & trained) == (cameras < 8)
    (folder / "test.txt").write_text("frame_0010.png\n")
    capture = load_capture(folder, RIG)
    assert held_out(capture) == of_cameras("frame_0010", times=8)
    assert "frame_0010" not in {Path(name).parent.name for name in held_out(capture, "train")}


def test_an_unknown_name_in_the_test_list_of_a_rig_is_refused(tmp_path: Path) -> None:
    folder = rig(tmp_path)
    (folder / "test.txt").write_text("frame_0000\n")
    with pytest.raises(CaptureError, match=r"^test\.txt: 'frame_0000' is no image of the model"):
        load_capture(folder, RIG)


@pytest.mark.parametrize("listed", ["images/frame_00003.png", "./images/frame_00003.jpg", "frame_00003/0.png"])
def test_split_lists_of_a_transforms_file_name_cameras_or_frames(tmp_path: Path, listed: str) -> None:
    folder = transforms_rig(tmp_path, test_filenames=[listed], val_filenames=["images/frame_00005.png"])
    capture = load_capture(folder, RIG)
    times = [0] if listed.startswith("frame") else [0, 1]
    assert held_out(capture) == {f"frame_00003/{time}.png" for time in times}
    assert held_out(capture, "val") == {"frame_00005/0.png", "frame_00005/1.png"}
    assert len(capture.train) == 18 - len(times) - 2


def test_training_cameras_that_are_listed_are_those_that_are_used(tmp_path: Path) -> None:
    folder = transforms_rig(tmp_path, train_filenames=[f"images/frame_{index:05d}.png" for index in (1, 2)])
    capture = load_capture(folder, RIG)
    assert held_out(capture, "train") == {f"frame_{index:05d}/{time}.png" for index in (1, 2) for time in (0, 1)}


def test_frames_have_the_mask_of_their_camera(tmp_path: Path) -> None:
    folder = rig(tmp_path)
    for camera in range(0, 9, 2):
        mask = np.full((20, 32, 1), 255, np.uint8)
        mask[:, : 2 + camera] = 0
        write_image(folder / f"masks/frame_{10 * camera:04d}.png.png", mask)
    images = ImageStore((0.0, 0.0, 0.0))
    for _, frame in load_capture(folder, RIG):
        camera, valid = int(frame.name[6:10]) // 10, images.valid(frame)
        if camera % 2:
            assert valid is None
        else:
            assert valid is not None
            assert valid.tolist() == [[column >= 2 + camera for column in range(32)]] * 20


def test_masks_of_a_transforms_file_are_those_of_its_cameras_too(tmp_path: Path) -> None:
    write_image(tmp_path / "mask.png", np.repeat(np.uint8([[[0], [255]]]), 8, axis=0).repeat(8, axis=1))
    folder = transforms_rig(tmp_path, frame={"mask_path": "mask.png"})
    write_image(folder / "mask.png", np.repeat(np.uint8([[[0]] * 32 + [[255]] * 32]), 40, axis=0))
    images = ImageStore((0.0, 0.0, 0.0))
    for _, frame in load_capture(folder, RIG):
        valid = images.valid(frame)
        assert valid is not None
        assert valid.mean() == 0.5


def test_transforms_files_per_split_hold_out_their_cameras(tmp_path: Path) -> None:
    folder = write_dnerf(tmp_path)
    (folder / "transforms_val.json").unlink()
    for split, camera in (("test", 7), ("val", 8)):
        write_image(folder / f"{split}/r_{camera:03d}.png", pixels(12, 12, seed=camera))
        write_transforms(folder, split, [entry(orbit(camera, 9), f"./{split}/r_{camera:03d}")])
    cameras = [*(f"train/r_{index:03d}" for index in range(4)), "test/r_007", "val/r_008"]
    for camera in cameras:
        for time in range(3):
            write_image(folder / f"{camera}/f{5 + time:03d}.png", pixels(12, 12, seed=time))
    capture = load_capture(folder, RIG)
    assert held_out(capture, "train") == of_cameras(*cameras[:4])
    assert held_out(capture) == of_cameras("test/r_007")
    assert held_out(capture, "val") == of_cameras("val/r_008")
    assert capture.times.tolist() == [0.0, 0.5, 1.0]
    for split, frame in capture:
        if split == "test":
            expected = orbit(7, 9).world_to_camera
            np.testing.assert_allclose(capture.units.camera_back(frame.camera), expected, atol=1e-12)


def test_an_empty_split_has_no_cameras(tmp_path: Path) -> None:
    folder = write_dnerf(tmp_path)  # with a val file that lists nothing
    for camera in range(4):
        for time in range(2):
            write_image(folder / f"train/r_{camera:03d}/{time}.png", pixels(12, 12, seed=time))
    capture = load_capture(folder, RIG)
    assert [len(capture.split(split)) for split in ("train", "val", "test")] == [8, 0, 0]
    assert [note for note in capture.notes if "rig" in note] == [
        "a rig: 8 frames of 4 cameras, with the numbers in their names as times"
    ]


def test_names_of_calibrated_images_need_no_number(tmp_path: Path) -> None:
    folder = transforms_rig(tmp_path)
    (folder / "images/frame_00002.png").rename(folder / "images/left.png")
    (folder / "frame_00002").rename(folder / "left")
    path = folder / "transforms.json"
    path.write_text(path.read_text().replace("frame_00002", "left"))
    capture = load_capture(folder, CaptureConfig(rig=True, times_from_names=True))
    assert capture.times.tolist() == [0.0, 1.0]
