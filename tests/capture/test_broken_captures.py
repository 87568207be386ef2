"""Captures that cannot be used: each is refused with file, field and what is wrong."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graings.capture.load import load_capture
from graings.errors import CaptureError
from tests.capture.captures import Break, cut, entry, orbit, pixels, write_dnerf, write_image, write_transforms

TIMES = [0.0, 0.25, 0.5, 1.0]
TRAIN = "transforms_train.json"


def edit(change: Callable[[dict[str, Any]], Any]) -> Break:
    """Change the parsed transforms_train.json."""

    def apply(folder: Path) -> None:
        path = folder / TRAIN
        document = json.loads(path.read_text())
        change(document)
        path.write_text(json.dumps(document))

    return apply


def frame(**keys: Any) -> Break:
    """Set keys of the third frame."""
    return edit(lambda document: document["frames"][2].update(keys))


def matrix(change: Callable[[np.ndarray], Any]) -> Break:
    """Change the pose of the third frame in place."""

    def apply(document: dict[str, Any]) -> None:
        pose = np.array(document["frames"][2]["transform_matrix"])
        change(pose)
        document["frames"][2]["transform_matrix"] = pose.tolist()

    return edit(apply)


def as_jpeg(keep: float) -> Break:
    """Replace the third image by a JPEG that is truncated to a fraction of its bytes."""

    def apply(folder: Path) -> None:
        path = write_image(folder / "train/r_002.jpg", pixels(64, 64, 3))
        (folder / "train/r_002.png").unlink()
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * keep)])

    return apply


def as_exr(folder: Path) -> None:
    path = write_image(folder / "train/r_002.exr", pixels(64, 64, 3).astype(np.float32), "half")
    (folder / "train/r_002.png").unlink()
    path.write_bytes(path.read_bytes()[:-200])


def flip_a_byte(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0xFF]) + data[middle + 1 :]


def link_outside(folder: Path) -> None:
    secret = write_image(folder.parent / "outside.png", pixels(12, 12))
    (folder / "train/r_002.png").unlink()
    os.symlink(secret, folder / "train/r_002.png")


def shear(pose: np.ndarray) -> None:
    pose[:3, 0] += 0.2 * pose[:3, 1]


def mirror(pose: np.ndarray) -> None:
    pose[:3, 0] *= -1


def flatten(pose: np.ndarray) -> None:
    pose[:3, 2] = 0


def wreck_last_row(pose: np.ndarray) -> None:
    pose[3] = (0, 0, 1, 1)


BROKEN: dict[str, tuple[Break, str]] = {
    "missing image": (lambda f: (f / "train/r_002.png").unlink(), rf"{TRAIN}, frames\[2\]\.file_path: .*is missing"),
    "truncated PNG": (cut("train/r_002.png", lambda d: d[: len(d) // 2]), r"train/r_002\.png: is truncated or damaged"),
    "PNG without end": (cut("train/r_002.png", lambda d: d[:-12]), r"train/r_002\.png: is truncated"),
    "damaged PNG": (cut("train/r_002.png", flip_a_byte), r"train/r_002\.png: is truncated or damaged"),
    "empty image": (cut("train/r_002.png", lambda d: b""), r"train/r_002\.png: is truncated"),
    "truncated JPEG": (as_jpeg(0.7), r"train/r_002\.jpg: is truncated"),
    "JPEG header only": (as_jpeg(0.01), r"train/r_002\.jpg: is truncated"),
    "truncated EXR": (as_exr, r"train/r_002\.exr: cannot be (decoded|opened)"),
    "text as image": (cut("train/r_002.png", lambda d: b"hello"), r"train/r_002\.png: is no image of a known format"),
    "broken JSON": (cut(TRAIN, lambda d: d[:200]), rf"{TRAIN}: invalid JSON"),
    "JSON that is a list": (cut(TRAIN, lambda d: b"[]"), rf"{TRAIN}: input should be an object"),
    "JSON with bad text": (cut(TRAIN, lambda d: b"\xff\xfe{}"), rf"{TRAIN}: "),
    "deeply nested JSON": (cut(TRAIN, lambda d: b"[" * 100_000), rf"{TRAIN}: "),
    "no frames key": (edit(lambda d: d.pop("frames")), rf"{TRAIN}, frames: the key is missing"),
    "zero frames": (edit(lambda d: d.update(frames=[])), rf"{TRAIN}, frames: has no frames"),
    "no pose": (
        edit(lambda d: d["frames"][2].pop("transform_matrix")),
        rf"{TRAIN}, frames\[2\]\.transform_matrix: the key is missing",
    ),
    "no focal length": (edit(lambda d: d.pop("camera_angle_x")), rf"{TRAIN}, frames\[0\]: no focal length"),
    "file_path is a number": (frame(file_path=3), rf"{TRAIN}, frames\[2\]\.file_path: .*valid string"),
    "time is text": (frame(time="NaN"), rf"{TRAIN}, frames\[2\]\.time: .*valid number"),
    "time is not finite": (frame(time=math.nan), rf"{TRAIN}, frames\[2\]\.time: .*finite number"),
    "time is infinite": (frame(time=-math.inf), rf"{TRAIN}, frames\[2\]\.time: .*finite number"),
    "time is too large": (frame(time=1e300), r"train/r_002\.png, time: is 1e\+300"),
    "time is true": (frame(time=True), rf"{TRAIN}, frames\[2\]\.time: .*valid number"),
    "time for some only": (
        edit(lambda d: d["frames"][2].pop("time")),
        rf"{TRAIN}, time of train/r_002\.png: the time is missing here but given for other frames",
    ),
    "pose is not finite": (
        matrix(lambda m: m.__setitem__((0, 3), math.nan)),
        rf"{TRAIN}, frames\[2\]\.transform_matrix\[0\]\[3\]: .*finite number",
    ),
    "pose is too large": (
        matrix(lambda m: m.__setitem__((0, 3), 1e200)),
        r"train/r_002\.png, camera position: is 1e\+200",
    ),
    "pose of three rows": (
        frame(transform_matrix=np.eye(4)[:3].tolist()),
        rf"{TRAIN}, frames\[2\]\.transform_matrix: .*at least 4 items",
    ),
    "pose mirrors": (matrix(mirror), rf"{TRAIN}, frames\[2\]\.transform_matrix: the rotation part mirrors"),
    "pose shears": (matrix(shear), rf"{TRAIN}, frames\[2\]\.transform_matrix: the rotation part shears"),
    "pose is singular": (matrix(flatten), rf"{TRAIN}, frames\[2\]\.transform_matrix: the rotation part is singular"),
    "pose with a wrong last row": (matrix(wreck_last_row), rf"{TRAIN}, frames\[2\]\.transform_matrix: the last row"),
    "negative focal length": (frame(fl_x=-20.0), rf"{TRAIN}, frames\[2\]\.fl_x: .*greater than 0"),
    "an angle that is too small": (frame(camera_angle_x=5e-324), rf"{TRAIN}, frames\[2\]\.camera_angle_x: .*greater"),
    "a focal length of many images": (frame(fl_x=1e9), r"train/r_002.png, focal length fx: .* image sizes"),
    "a focal length that is too short": (frame(fl_x=1e-9), r"train/r_002.png, focal length fx: .* image sizes"),
    "a principal point far away": (frame(cx=1e308), r"train/r_002.png, principal point cx: is .* image sizes"),
    "zero angle": (edit(lambda d: d.update(camera_angle_x=0.0)), rf"{TRAIN}, camera_angle_x: .*greater than"),
    "angle of 180 degrees": (frame(camera_angle_x=math.pi), rf"{TRAIN}, frames\[2\]\.camera_angle_x: .*less than"),
    "width of zero": (frame(w=0), rf"{TRAIN}, frames\[2\]\.w: .*greater than 0"),
    "intrinsics for another aspect ratio": (frame(w=12, h=24), rf"{TRAIN}, frames\[2\]\.w, h: .*12x24 px.*has 12x12"),
    "a lens with four radial coefficients": (frame(k4=0.1), rf"{TRAIN}, frames\[2\]: a fourth radial coefficient"),
    "frame listed twice": (
        frame(file_path="train/../train/r_001.png"),
        rf"{TRAIN}, frames\[2\]\.file_path: the image train/r_001\.png is listed twice, first in frames\[1\]",
    ),
    "path above the capture": (frame(file_path="../outside"), rf"{TRAIN}, frames\[2\]\.file_path: .*leads outside"),
    "absolute path": (frame(file_path="/etc/hostname"), rf"{TRAIN}, frames\[2\]\.file_path: .*leads outside"),
    "link to the outside": (link_outside, rf"{TRAIN}, frames\[2\]\.file_path: .*leads outside"),
    "path with a NUL": (frame(file_path="a\0b"), rf"{TRAIN}, frames\[2\]\.file_path: cannot use the path"),
    "path that is too long": (frame(file_path="a" * 10_000), rf"{TRAIN}, frames\[2\]\.file_path: cannot use the path"),
    "train file missing": (
        lambda f: (f / TRAIN).rename(f / "transforms_test.json"),
        rf"{TRAIN}: is missing",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_capture_is_refused_with_its_reason(tmp_path: Path, name: str) -> None:
    (tmp_path / "scene").mkdir()
    folder = write_dnerf(tmp_path / "scene", TIMES)
    load_capture(folder)  # valid before it is damaged
    breaks, message = BROKEN[name]
    breaks(folder)
    with pytest.raises(CaptureError, match=f"^{message}") as caught:
        load_capture(folder)
    assert caught.value.remedy
    assert str(tmp_path) not in str(caught.value)


def test_broken_held_out_split_is_refused_too(tmp_path: Path) -> None:
    write_dnerf(tmp_path, TIMES)
    write_image(tmp_path / "test/r_001.png", pixels(12, 12))
    write_transforms(tmp_path, "test", [entry(orbit(i, 4), f"./test/r_{i:03d}", 0.5) for i in range(2)])
    with pytest.raises(CaptureError, match=r"^transforms_test\.json, frames\[0\]\.file_path: .*is missing"):
        load_capture(tmp_path)


def test_error_for_a_folder_without_a_capture_lists_the_formats(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing here")
    with pytest.raises(
        CaptureError,
        match=r"contains no capture: neither transforms_train\.json .* nor transforms\.json .* nor a COLMAP model",
    ):
        load_capture(tmp_path)


def test_folder_of_several_captures_names_them(tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        write_dnerf(tmp_path / name)
    with pytest.raises(CaptureError, match=r"contains several captures \(left, right\)"):
        load_capture(tmp_path)


def test_file_in_place_of_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene.zip").write_bytes(b"PK")
    with pytest.raises(CaptureError, match="is not a folder"):
        load_capture(tmp_path / "scene.zip")
