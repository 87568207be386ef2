"""Cameras of frames: one for each size of images, whichever order they come in."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.footage.make_capture import make_capture
from graings.footage.poses import reconstruct
from graings.image_encoding import encode_image
from tests.footage.clips import film

pycolmap = pytest.importorskip("pycolmap")

# Sizes of photographs, width and height in px: of one camera, held upright and across, of two cameras, and cropped.
SIZES = {
    "one": [(96, 64)],
    "upright and across": [(96, 64), (64, 96)],
    "the first of its kind": [(64, 96)] + [(96, 64)] * 11,
    "three": [(96, 64), (64, 96), (80, 80)],
}


class Matching(Exception):
    """All features are there."""


def until_matching(folder: Path, names: list[str]) -> None:
    def observe(phase: str, done: int, total: int) -> None:
        if phase == "matching":
            raise Matching

    with pytest.raises(Matching):
        reconstruct(folder, names, folder, 1, observe)


@pytest.mark.parametrize("kind", SIZES)
def test_every_frame_has_features_and_a_camera_of_its_size(tmp_path: Path, kind: str) -> None:
    sizes = [SIZES[kind][index % len(SIZES[kind])] for index in range(12)]
    names = [f"{index:05d}.png" for index in range(12)]
    for index, (name, (width, height)) in enumerate(zip(names, sizes, strict=True)):
        image = np.random.default_rng(index).random((height, width, 3), dtype=np.float32)
        (tmp_path / name).write_bytes(encode_image(image))
    until_matching(tmp_path, names[:6])
    until_matching(tmp_path, names)  # continues with the cameras that are there
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        found = {image.name: database.read_camera(image.camera_id) for image in database.read_all_images()}
        assert database.num_cameras() == len(set(sizes))
    assert {name: (camera.width, camera.height) for name, camera in found.items()} == dict(
        zip(names, sizes, strict=True)
    )


@pytest.mark.slow("a scene is drawn 24 times at 320 px, and its cameras are found")
def test_photographs_held_upright_and_across_become_one_capture(tmp_path: Path) -> None:
    images, _ = film("room", 24, 320)
    (tmp_path / "photos").mkdir()
    for index, image in enumerate(images):
        part = image[:, 40:280] if index % 3 == 0 else image[40:280]
        content = encode_image(part.astype(np.float32) / 255)
        (tmp_path / "photos" / f"{index}.png").write_bytes(content)
    report = make_capture(tmp_path / "photos", tmp_path / "c")
    assert report.registered == 24
    assert (report.camera.width, report.camera.height) == (320, 240)
    assert any("2 sizes" in note for note in report.notes)
    capture = load_capture(tmp_path / "c", CaptureConfig())
    wide = [frame.camera for _, frame in capture if frame.camera.width > frame.camera.height]
    assert len(wide) == 16
    for _, frame in capture:  # one lens filmed both, so that the focal length is 256 px in both
        assert math.isclose(frame.camera.fx, 0.8 * 320, rel_tol=0.05)
