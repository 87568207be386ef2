"""Tiny captures that tests write to disk, and ways to damage them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import CaptureConfig

FOV = 0.7

Break = Callable[[Path], Any]


def pixels(height: int, width: int, channels: int = 4, seed: int = 0) -> NDArray[np.uint8]:
    """Random 8-bit pixels [H, W, C]."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def write_image(path: Path, image: NDArray[Any], stored: str | None = None) -> Path:
    """Write `image` [H, W, C] as it is, alpha straight; `stored` is OpenImageIO's pixel type."""
    path.parent.mkdir(parents=True, exist_ok=True)
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], image.shape[2], stored or str(image.dtype))
    spec["oiio:UnassociatedAlpha"] = 1
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(np.ascontiguousarray(image)), output.geterror()
    assert output.close()
    return path


def without_alpha(capture: Path, color: Sequence[float] = (1.0, 1.0, 1.0)) -> Path:
    """Composite every image of `capture` on `color`, as files with three channels; returns `capture`."""
    images = ImageStore(color)
    for _, frame in load_capture(capture, CaptureConfig(max_side=None)):
        write_image(frame.image_path, np.rint(images.rgb(frame) * 255).astype(np.uint8))
    return capture


def orbit(index: int, count: int, size: tuple[int, int] = (12, 12), radius: float = 4.0) -> Camera:
    """One of `count` cameras on a ring, looking at the origin."""
    return Camera.orbit(360.0 * index / count, 20.0, radius, fov=FOV, width=size[0], height=size[1])


def opengl(camera: Camera) -> list[list[float]]:
    """The camera's pose as `transform_matrix`: camera to world, y up, z back."""
    pose = np.linalg.inv(camera.world_to_camera)
    pose[:3, 1:3] *= -1.0
    return pose.tolist()  # type: ignore[no-any-return]


def entry(camera: Camera, name: str, time: float | None = None, **keys: Any) -> dict[str, Any]:
    """One frame of a transforms file."""
    frame = {"file_path": name, "transform_matrix": opengl(camera), **keys}
    return frame if time is None else {**frame, "time": time}


def write_transforms(folder: Path, split: str, frames: list[dict[str, Any]], **keys: Any) -> Path:
    """Write one transforms file; returns its path."""
    path = folder / f"transforms_{split}.json"
    path.write_text(json.dumps({"camera_angle_x": FOV, **keys, "frames": frames}))
    return path


def write_dnerf(folder: Path, times: list[float] | None = None, *, radius: float = 4.0) -> Path:
    """A valid capture of four training images (or one for each of `times`) of 12x12 px."""
    count = 4 if times is None else len(times)
    for index in range(count):
        write_image(folder / f"train/r_{index:03d}.png", pixels(12, 12, seed=index))
    frames = [
        entry(orbit(i, count, radius=radius), f"./train/r_{i:03d}", None if times is None else times[i])
        for i in range(count)
    ]
    write_transforms(folder, "train", frames)
    write_transforms(folder, "val", [])  # otherwise images would be held out
    return folder


def write_single(folder: Path, count: int = 20, *, frame: dict[str, Any] | None = None, **top: Any) -> Path:
    """A valid capture of `count` images of 64x40 px on a ring, in one transforms.json whose frames are not sorted."""
    lens = {"fl_x": 60.0, "fl_y": 62.0, "cx": 33.0, "cy": 19.0, "w": 64, "h": 40}
    frames = []
    for index in range(count):
        name = f"images/frame_{index:05d}.png"
        write_image(folder / name, pixels(40, 64, 3, seed=index))
        frames.append(entry(orbit(index, count), name, **(frame or {})))
    document = {**lens, "camera_model": "OPENCV", **top, "frames": frames[::-1]}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def write_walled(folder: Path, cameras: Sequence[Camera]) -> Path:
    """Opaque images that a painted floor (z = 0) fills, at different times; every eighth is held out."""
    paint = np.random.default_rng(0).random((64, 64, 3))
    frames: dict[str, list[dict[str, Any]]] = {"train": [], "val": []}
    for index, camera in enumerate(cameras):
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
        towards = local @ camera.world_to_camera[:3, :3]
        x, y, _ = np.moveaxis(camera.center - camera.center[2] / towards[..., 2:] * towards, -1, 0)
        colors = interpolated(paint, 5.0 * x, 5.0 * y)
        name = f"images/{index:03d}"
        write_image(folder / f"{name}.png", np.rint(255 * colors).astype(np.uint8))
        frames["val" if index % 8 == 7 else "train"].append(entry(camera, name, index / len(cameras)))
    for split, entries in frames.items():
        if entries:
            write_transforms(folder, split, entries)
    return folder


def interpolated(paint: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """`paint` [n, n, 3], repeated periodically, at x and y, smoothly interpolated."""
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    wx, wy = (3 * w**2 - 2 * w**3 for w in ((x - left)[..., None], (y - top)[..., None]))
    above, below = (
        (1 - wx) * paint[row % len(paint), left % len(paint)] + wx * paint[row % len(paint), (left + 1) % len(paint)]
        for row in (top, top + 1)
    )
    return (1 - wy) * above + wy * below


def write_colmap(
    folder: Path,
    *,
    count: int = 10,
    model: str = "PINHOLE",
    params: tuple[float, ...] = (30.0, 31.0, 15.5, 10.5),
    size: tuple[int, int] = (32, 20),
    text: bool = False,
    where: str = "sparse/0",
    points: int = 40,
) -> Path:
    """A COLMAP folder written by pycolmap: cameras on a ring, points in a ball, images of noise."""
    (folder / where).mkdir(parents=True, exist_ok=True)
    pycolmap = pytest.importorskip("pycolmap")  # absent on Linux on ARM
    scene = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=list(params), camera_id=1)
    scene.add_camera_with_trivial_rig(camera)
    for index in range(count):
        name = f"frame_{10 * index:04d}.png"
        write_image(folder / "images" / name, pixels(size[1], size[0], 3, seed=index))
        pose = orbit(index, count).world_to_camera
        image = pycolmap.Image(name=name, camera_id=1, image_id=index + 1)
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    rng = np.random.default_rng(0)
    for position in rng.normal(size=(points, 3)) * 0.3:
        scene.add_point3D(position, pycolmap.Track(), np.array([255, 51, 0], dtype=np.uint8))
    (scene.write_text if text else scene.write_binary)(str(folder / where))
    return folder


def cut(name: str, keep: Callable[[bytes], bytes]) -> Break:
    """Rewrite a file's bytes."""
    return lambda folder: (folder / name).write_bytes(keep((folder / name).read_bytes()))
