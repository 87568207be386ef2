"""The layout of Nerfies, HyperNeRF and DyCheck."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graings.camera.camera import Camera
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.errors import CaptureError
from tests.capture.captures import cut, orbit, pixels, write_image

BLACK = (0.0, 0.0, 0.0)


def camera_entry(camera: Camera, scale: int, **keys: Any) -> dict[str, Any]:
    """A camera for images `scale` times as large as those of `camera`."""
    return {
        "orientation": camera.world_to_camera[:3, :3].tolist(),
        "position": camera.center.tolist(),
        "focal_length": camera.fx * scale,
        "pixel_aspect_ratio": camera.fy / camera.fx,
        "principal_point": [camera.cx * scale, camera.cy * scale],
        "image_size": [camera.width * scale, camera.height * scale],
        "skew": 0.0,
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
        **keys,
    }


def write_nerfies(folder: Path, count: int = 12, *, val: bool = True, **keys: Any) -> Path:
    """Images of 48x32 px at 1x and 24x16 at 2x; the last third is held out, with covisible masks at 2x."""
    names = [f"{int(index >= 8)}_{index:05d}" for index in range(count)]
    for index, name in enumerate(names):
        for scale, size in ((1, (32, 48)), (2, (16, 24))):
            write_image(folder / f"rgb/{scale}x/{name}.png", pixels(*size, 3, seed=index))
        (folder / "camera").mkdir(exist_ok=True)
        entry = camera_entry(orbit(index, count, (24, 16)), 2, **keys)
        (folder / f"camera/{name}.json").write_text(json.dumps(entry))
    held_out = names[8:] if val else []
    for name in held_out:
        valid = np.full((16, 24, 1), 255, np.uint8)
        valid[:4] = 0
        write_image(folder / f"covisible/2x/val/{name}.png", valid)
    train = [name for name in names if name not in held_out]
    dataset = {"count": count, "ids": names, "train_ids": train, "val_ids": held_out}
    (folder / "dataset.json").write_text(json.dumps(dataset))
    metadata = {name: {"warp_id": 2 * (index % 8), "appearance_id": index} for index, name in enumerate(names)}
    (folder / "metadata.json").write_text(json.dumps(metadata))
    (folder / "scene.json").write_text('{"scale": 0.3, "center": [5, 6, 7], "near": 0.1, "far": 1.0}')
    np.save(folder / "points.npy", np.array([[0.0, 0.0, 0.5], [0.25, 0.0, 0.0]], np.float32))
    return folder


def test_cameras_times_points_and_splits_are_those_of_the_files(tmp_path: Path) -> None:
    capture = load_capture(write_nerfies(tmp_path), CaptureConfig(max_side=None))
    assert capture.kind == "nerfies"
    assert (len(capture.train), len(capture.val), len(capture.test)) == (8, 4, 0)
    for split, frame in capture:
        index = int(frame.name[-9:-4])
        assert split == ("train" if index < 8 else "val")
        assert frame.time == pytest.approx((index % 8) / 7)
        expected = orbit(index, 12, (48, 32))
        np.testing.assert_allclose(capture.units.camera_back(frame.camera), expected.world_to_camera, atol=1e-12)
        ours = frame.camera
        assert (ours.fx, ours.fy, ours.cx, ours.cy) == pytest.approx((expected.fx, expected.fy, 24.0, 16.0))
    assert capture.points is not None
    points = capture.units.points_back(capture.points.positions)
    np.testing.assert_allclose(points, [[0, 0, 0.5], [0.25, 0, 0]], atol=1e-7)


def test_a_rig_is_refused_as_its_frames_are_listed_already(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"^dataset\.json, capture\.rig: lists every frame itself.*rig=false"):
        load_capture(write_nerfies(tmp_path), CaptureConfig(rig=True))


@pytest.mark.parametrize(("max_side", "scale"), [(None, "1x"), (40, "1x"), (24, "2x"), (16, "2x"), (400, "1x")])
def test_the_smallest_pictures_that_suffice_are_read(tmp_path: Path, max_side: int | None, scale: str) -> None:
    capture = load_capture(write_nerfies(tmp_path), CaptureConfig(max_side=max_side))
    assert capture.train[0].name.startswith(f"rgb/{scale}/")
    assert f"images are those of rgb/{scale}" in capture.notes


def test_covisible_masks_are_those_of_held_out_views(tmp_path: Path) -> None:
    capture = load_capture(write_nerfies(tmp_path), CaptureConfig(max_side=24))
    images = ImageStore(BLACK)
    assert all(images.valid(frame) is None for frame in capture.train)
    for frame in capture.val:
        valid = images.valid(frame)
        assert valid is not None
        assert valid.tolist() == [[row >= 4] * 24 for row in range(16)]


@pytest.mark.parametrize("keys", [("tangential_distortion",), ("tangential",), ("tangential", "tangential_distortion")])
def test_a_distorted_lens_is_undistorted_as_opencv_orders_its_coefficients(
    tmp_path: Path, keys: tuple[str, ...]
) -> None:
    folder = write_nerfies(tmp_path, radial_distortion=[0.1, 0.01, 0.002])
    for path in (folder / "camera").iterdir():
        entry = json.loads(path.read_text())
        del entry["tangential_distortion"]
        path.write_text(json.dumps({**entry, **{key: [0.003, -0.002] for key in keys}}))
    lens = load_capture(folder).train[0].lens
    assert lens is not None
    assert lens.model == "FULL_OPENCV"
    assert lens.params[4:] == (0.1, 0.01, 0.003, -0.002, 0.002, 0.0, 0.0, 0.0)


def test_images_are_held_out_where_the_capture_holds_none_out(tmp_path: Path) -> None:
    capture = load_capture(write_nerfies(tmp_path, val=False))
    assert (len(capture.train), len(capture.val), len(capture.test)) == (9, 1, 2)


def test_a_time_id_wins_over_the_warp_id(tmp_path: Path) -> None:
    folder = write_nerfies(tmp_path)
    metadata = json.loads((folder / "metadata.json").read_text())
    for index, entry in enumerate(metadata.values()):
        entry["time_id"] = 11 - index
    (folder / "metadata.json").write_text(json.dumps(metadata))
    assert load_capture(folder).train[0].time == 1.0


def camera(**keys: Any) -> Callable[[Path], Any]:
    def apply(folder: Path) -> None:
        path = folder / "camera/0_00003.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **keys}))

    return apply


def array(values: Any) -> Callable[[Path], Any]:
    return lambda folder: np.save(folder / "points.npy", values)


@pytest.mark.parametrize("key", ["tangential", "tangential_distortion"])
def test_a_distortion_that_is_no_pair_is_refused_under_either_name(tmp_path: Path, key: str) -> None:
    folder = write_nerfies(tmp_path)
    for path in (folder / "camera").iterdir():
        entry = json.loads(path.read_text())
        del entry["tangential_distortion"]
        path.write_text(json.dumps({**entry, key: [0.003]}))
    with pytest.raises(CaptureError, match=rf"^camera/0_00000\.json, {key}"):
        load_capture(folder)


MIRROR = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]
BROKEN: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no pictures": (lambda f: (f / "rgb").rename(f / "pictures"), r"rgb: has no folder of pictures"),
    "no camera": (lambda f: (f / "camera/0_00003.json").unlink(), r"camera/0_00003\.json: is missing"),
    "orientation that mirrors": (camera(orientation=MIRROR), r"camera/0_00003\.json, orientation: is no rotation"),
    "skew": (camera(skew=1.0), r"camera/0_00003\.json, skew: is 1"),
    "another aspect ratio": (camera(image_size=[48, 48]), r"camera/0_00003\.json, image_size: is 48x48 px, the image"),
    "position that is not finite": (
        cut("camera/0_00003.json", lambda d: d.replace(b'"position": [', b'"position": [1e999, ')),
        r"camera/0_00003\.json",
    ),
    "no entry": (
        cut("metadata.json", lambda d: d.replace(b"0_00003", b"0_10003")),
        r"metadata\.json, 0_00003: the entry",
    ),
    "points that are text": (cut("points.npy", lambda d: b"text"), r"points\.npy: is no array"),
    "points that are objects": (array(np.array([[{}, {}, {}]], dtype=object)), r"points\.npy, dtype: holds object"),
    "points of two numbers": (array(np.zeros((4, 2))), r"points\.npy, shape: holds \(4, 2\), not \(N, 3\)"),
    "truncated points": (cut("points.npy", lambda d: d[:-5]), r"points\.npy: is truncated: it declares \d+ rows"),
    "nothing to train on": (
        cut(
            "dataset.json",
            lambda d: (
                d.replace(b"train_ids", b"tram_ids")
                .replace(b'"ids"', b'"val_ids"')
                .replace(b'"val_ids": ["1', b'"ids": ["1')
            ),
        ),
        r"dataset\.json",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_nerfies_folder_is_refused_with_its_reason(tmp_path: Path, name: str) -> None:
    folder = write_nerfies(tmp_path)
    load_capture(folder)  # valid before it is damaged
    breaks, message = BROKEN[name]
    breaks(folder)
    with pytest.raises(CaptureError, match=f"^{message}") as caught:
        load_capture(folder)
    assert caught.value.remedy
