"""Masks: pixels to ignore, from the capture's files to the image store."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from graings.capture.background import border_color
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.errors import CaptureError
from graings.plan.capture_statistics import measure
from graings.training.initialization.visual_hull import masked, not_masked
from tests.capture.captures import pixels, write_colmap, write_dnerf, write_image, write_single

WHITE = (1.0, 1.0, 1.0)


def mask(height: int, width: int, value: int = 255) -> NDArray[np.uint8]:
    """Black in the left third."""
    valid = np.full((height, width, 1), value, np.uint8)
    valid[:, : width // 3] = 0
    return valid


def in_frames(folder: Path, file: str, key: str = "masks/{}.png") -> None:
    path = folder / file
    document = json.loads(path.read_text())
    for index, frame in enumerate(document["frames"]):
        frame["mask_path"] = key.format(index)
        frame.setdefault("time", index / len(document["frames"]))
    path.write_text(json.dumps(document))


def nerfstudio(folder: Path) -> Path:
    write_single(folder, 10)
    for index in range(10):
        write_image(folder / f"masks/{index}.png", mask(40, 64))
    in_frames(folder, "transforms.json")
    return folder


def dnerf(folder: Path) -> Path:
    write_dnerf(folder, [0.0, 0.2, 0.6, 1.0])
    for index in range(4):
        write_image(folder / f"masks/{index}.png", mask(12, 12, value=1))  # 0 and 1 instead of 0 and 255
    in_frames(folder, "transforms_train.json")
    return folder


def colmap(folder: Path, name: str = "frame_{:04d}.png.png") -> Path:
    write_colmap(folder)
    for index in range(10):
        write_image(folder / "masks" / name.format(10 * index), mask(20, 32))
    return folder


def beside_the_model(folder: Path) -> Path:
    return colmap(folder, "frame_{:04d}.png")


@pytest.mark.parametrize("write", [nerfstudio, dnerf, colmap, beside_the_model])
def test_black_pixels_of_a_mask_are_not_valid(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    capture = load_capture(write(tmp_path))
    images = ImageStore(WHITE)
    for _, frame in capture:
        valid = images.valid(frame)
        assert valid is not None
        third = frame.camera.width // 3
        assert not valid[:, :third].any()
        assert valid[:, third:].all()
    (found,) = [note for note in capture.notes if "mask" in note]
    assert f"{len(list(capture))} of " in found
    assert "no loss, no metric" in found


def test_a_reduced_pixel_is_valid_where_all_its_pixels_are(tmp_path: Path) -> None:
    capture = load_capture(nerfstudio(tmp_path), CaptureConfig(max_side=16))
    valid = ImageStore(WHITE).valid(capture.train[0])  # 64 px to 16: four to one, 21 of them masked
    assert valid is not None
    assert valid.tolist() == [[False] * 6 + [True] * 10] * 10


def test_a_mask_is_undistorted_with_its_image(tmp_path: Path) -> None:
    folder = colmap(tmp_path)
    straight = load_capture(folder)
    bent = tmp_path / "bent"
    write_colmap(bent, model="SIMPLE_RADIAL", params=(30.0, 16.0, 10.0, 0.2))
    (folder / "masks").rename(bent / "masks")
    for index in range(10):  # the mask as a picture: what is black in one is black in the other
        image = np.repeat(mask(20, 32), 3, axis=2)
        write_image(bent / f"images/frame_{10 * index:04d}.png", image)
    capture = load_capture(bent)
    images = ImageStore(WHITE)
    assert capture.train[0].lens is not None
    valid, image = images.valid(capture.train[0]), images.rgb(capture.train[0])
    assert valid is not None
    np.testing.assert_array_equal(valid, image[..., 0] > 1 - 1e-3)
    assert 0.5 < valid.mean() < 1
    assert straight.train[0].lens is None


def test_a_mask_that_hides_nothing_counts_as_none(tmp_path: Path) -> None:
    folder = nerfstudio(tmp_path)
    for index in range(10):
        write_image(folder / f"masks/{index}.png", np.full((40, 64, 1), 255, np.uint8))
    assert ImageStore(WHITE).valid(load_capture(folder).train[0]) is None


def test_a_smaller_mask_is_enlarged_and_another_shape_refused(tmp_path: Path) -> None:
    folder = nerfstudio(tmp_path)
    for index in range(10):
        write_image(folder / f"masks/{index}.png", mask(20, 32))
    valid = ImageStore(WHITE).valid(load_capture(folder).train[0])
    assert valid is not None
    assert valid.shape == (40, 64)
    assert valid[0].tolist() == [False] * 20 + [True] * 44
    write_image(folder / "masks/3.png", mask(40, 40))
    with pytest.raises(CaptureError, match=r"^masks/3\.png, size: is a mask of 40x40 px for images/.* 64x40"):
        load_capture(folder)


def test_a_listed_mask_that_is_missing_is_refused(tmp_path: Path) -> None:
    folder = nerfstudio(tmp_path)
    (folder / "masks/3.png").unlink()
    with pytest.raises(CaptureError, match=r"^transforms\.json, frames\[3\]\.mask_path: the image 'masks/3\.png' is"):
        load_capture(folder)


def test_pixels_and_masks_can_be_asked_for_in_any_order(tmp_path: Path) -> None:
    frame = load_capture(nerfstudio(tmp_path)).train[0]
    orders: list[tuple[str, ...]] = [("rgb", "valid", "alpha"), ("valid", "rgb"), ("alpha", "valid")]
    for order in orders:
        images = ImageStore(WHITE, cache_mb=16)
        found: dict[str, Any] = {part: getattr(images, part)(frame) for part in order}
        assert found["valid"].dtype == np.bool_
        assert not found["valid"].all()
        images = ImageStore(WHITE)
        images.prefetch(frame)
        np.testing.assert_array_equal(images.valid(frame), found["valid"])


def test_masked_borders_do_not_decide_the_background(tmp_path: Path) -> None:
    folder = nerfstudio(tmp_path)
    for index in range(10):
        image = np.full((40, 64, 3), (0, 51, 102), np.uint8)
        image[:, :21] = pixels(40, 21, 3, seed=index)
        write_image(folder / f"images/frame_{index:05d}.png", image)
    frames = load_capture(folder).train
    images = ImageStore(WHITE)
    assert border_color(frames, images) == pytest.approx((0, 0.2, 0.4))
    assert border_color([replace(frame, mask_path=None) for frame in frames], ImageStore(WHITE)) is None


def test_statistics_do_not_see_masked_pixels(tmp_path: Path) -> None:
    folder = nerfstudio(tmp_path)
    found = []
    for seed in (0, 1):
        for index in range(10):
            image = pixels(40, 64, 3, seed=index)
            image[:, :21] = pixels(40, 21, 3, seed=100 * seed + index) * seed
            write_image(folder / f"images/frame_{index:05d}.png", image)
        found.append(measure(load_capture(folder), ImageStore(WHITE), WHITE).model_copy(update={"cost_s": 0.0}))
    assert found[0] == found[1]


def test_masked_pixels_neither_carve_nor_keep_points(tmp_path: Path) -> None:
    capture = load_capture(dnerf(tmp_path))
    views = masked(capture.train, ImageStore(WHITE), WHITE)
    for view in views:
        assert view.valid is not None
        assert not view.mask[:, :4].any()
    camera = capture.train[0].camera
    local = np.array([[-1.0, 0.0], [1.0, 0.0]]) * 0.2  # left of the image's centre, and right of it
    depth = float(np.linalg.norm(camera.center))
    rays = np.column_stack([local, np.ones(2)]) @ camera.world_to_camera[:3, :3]
    points = camera.center + depth * rays
    kept = not_masked(points, capture.train[:1], ImageStore(WHITE))
    np.testing.assert_array_equal(kept, points[1:])
    unmasked = [replace(frame, mask_path=None) for frame in capture.train[:1]]
    np.testing.assert_array_equal(not_masked(points, unmasked, ImageStore(WHITE)), points)
