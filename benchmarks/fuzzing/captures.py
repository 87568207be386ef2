"""Captures: the JSON, NumPy and COLMAP files beside the pictures, one of which is hostile, read as a capture is."""

from __future__ import annotations

import io
import json
import struct
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from fuzzing import images
from fuzzing.archives import Damage
from fuzzing.mutations import NUMBERS, WIDE, mutated, mutated_json
from graings.camera.camera import Camera
from graings.capture.images import ImageStore
from graings.capture.load import load_capture

SIZE, COUNT = (24, 16), 6
PINHOLE = (30.0, 31.0, 12.0, 8.0)


def cameras() -> list[Camera]:
    return [Camera.orbit(360.0 * i / COUNT, 20.0, 4.0, fov=0.7, width=SIZE[0], height=SIZE[1]) for i in range(COUNT)]


def opengl(camera: Camera) -> list[list[float]]:
    pose = np.linalg.inv(camera.world_to_camera)
    pose[:3, 1:3] *= -1.0
    return pose.tolist()


def npy(values: np.ndarray) -> bytes:
    target = io.BytesIO()
    np.save(target, values)
    return target.getvalue()


def _dnerf() -> dict[str, Any]:
    frames = [
        {"file_path": f"./images/{i:03d}", "time": i / COUNT, "transform_matrix": opengl(camera)}
        for i, camera in enumerate(cameras())
    ]
    return {"transforms_train.json": {"camera_angle_x": 0.7, "frames": frames}, "transforms_val.json": {"frames": []}}


def _single() -> dict[str, Any]:
    lens = {"fl_x": 30.0, "fl_y": 31.0, "cx": 12.0, "cy": 8.0, "w": 24, "h": 16, "k1": 0.01, "camera_model": "OPENCV"}
    frames = [
        {"file_path": f"images/{i:03d}.png", "transform_matrix": opengl(camera)} for i, camera in enumerate(cameras())
    ]
    names = {"train_filenames": [f"images/{i:03d}.png" for i in range(COUNT - 1)], "val_filenames": ["images/005.png"]}
    return {"transforms.json": {**lens, **names, "frames": frames}}


def _nerfies() -> dict[str, Any]:
    names = [f"{i:03d}" for i in range(COUNT)]
    files: dict[str, Any] = {
        "dataset.json": {"count": COUNT, "ids": names, "train_ids": names[:-1], "val_ids": names[-1:]},
        "metadata.json": {name: {"warp_id": i, "appearance_id": i, "camera_id": 0} for i, name in enumerate(names)},
        "points.npy": npy(np.random.default_rng(0).normal(size=(9, 3))),
    }
    for name, camera in zip(names, cameras(), strict=True):
        files[f"camera/{name}.json"] = {
            **{"orientation": camera.world_to_camera[:3, :3].tolist(), "position": camera.center.tolist()},
            **{"focal_length": 30.0, "principal_point": [12.0, 8.0], "image_size": list(SIZE), "skew": 0.0},
            **{"pixel_aspect_ratio": 1.0, "radial_distortion": [0.01, 0.0, 0.0], "tangential_distortion": [0.0, 0.0]},
        }
    return files


def _llff() -> dict[str, Any]:
    rows = []
    for camera in cameras():
        pose = np.linalg.inv(camera.world_to_camera)[:3]
        matrix = np.column_stack([pose[:, 1], pose[:, 0], -pose[:, 2], pose[:, 3], (SIZE[1], SIZE[0], 30.0)])
        rows.append([*matrix.ravel(), 1.0, 9.0])
    return {"poses_bounds.npy": npy(np.array(rows))}


def colmap_files(text: bool) -> dict[str, bytes]:
    """cameras, images and points3D of a model, written by hand."""
    names = [f"{i:03d}.png" for i in range(COUNT)]
    poses = [(1.0, 0.0, 0.0, 0.0, float(i), 0.0, 4.0) for i in range(COUNT)]
    points = np.random.default_rng(0).normal(size=(5, 3))
    if text:
        posed = enumerate(zip(poses, names, strict=True), start=1)
        listed = "".join(f"{i} {' '.join(map(str, p))} 1 {n}\n1.0 2.0 -1\n" for i, (p, n) in posed)
        cloud = "".join(f"{i} {x} {y} {z} 255 9 0 0.5 1 0\n" for i, (x, y, z) in enumerate(points))
        return {
            "cameras.txt": b"# Number of cameras: 1\n1 PINHOLE 24 16 30 31 12 8\n",
            "images.txt": f"# Number of images: {COUNT}\n{listed}".encode(),
            "points3D.txt": cloud.encode(),
        }
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, *SIZE, *PINHOLE)
    registered = b"".join(
        struct.pack("<I7dI", i + 1, *pose, 1) + name.encode() + b"\0" + struct.pack("<Q2dq", 1, 1.0, 2.0, -1)
        for i, (pose, name) in enumerate(zip(poses, names, strict=True))
    )
    tracks = b"".join(struct.pack("<Q3d3BdQ2i", i, *row, 255, 9, 0, 0.5, 1, 1, 0) for i, row in enumerate(points))
    return {
        "cameras.bin": camera,
        "images.bin": struct.pack("<Q", COUNT) + registered,
        "points3D.bin": struct.pack("<Q", len(points)) + tracks,
    }


@cache
def layouts() -> dict[str, dict[str, bytes]]:
    """Files of each layout by name, without the pictures."""
    found: dict[str, dict[str, Any]] = {"dnerf": _dnerf(), "single": _single(), "nerfies": _nerfies(), "llff": _llff()}
    for name, text in (("colmap", False), ("colmap-text", True)):
        found[name] = {f"sparse/0/{file}": content for file, content in colmap_files(text).items()}
    found["colmap"]["times.json"] = {f"{i:03d}.png": i / COUNT for i in range(COUNT)}
    return {
        layout: {
            name: content if isinstance(content, bytes) else json.dumps(content).encode()
            for name, content in files.items()
        }
        for layout, files in found.items()
    }


def valid(*suffixes: str) -> tuple[tuple[str, bytes], ...]:
    """The files with one of these suffixes, by layout and name."""
    every = ((f"{layout}/{name}", data) for layout, files in layouts().items() for name, data in files.items())
    return tuple((name, data) for name, data in every if name.endswith(suffixes))


def _chosen(rng: Random, suffixes: tuple[str, ...]) -> tuple[str, bytes, list[bytes]]:
    some = valid(*suffixes)
    # Files of which a layout has many count as one.
    layout = rng.choice(sorted({name.split("/")[0] for name, _ in some}))
    name, data = rng.choice([one for one in some if one[0].startswith(f"{layout}/")])
    return name, data, [data for _, data in some]


def make_json(rng: Random) -> tuple[str, bytes]:
    name, data, others = _chosen(rng, (".json",))
    if rng.random() < 0.7:
        return name, mutated_json(json.loads(data), rng)
    return name, mutated(data, rng, others)


def make_colmap(rng: Random) -> tuple[str, bytes]:
    name, data, others = _chosen(rng, (".bin", ".txt"))
    if name.endswith(".bin") and rng.random() < 0.5:  # counts, ids, models and sizes are whole numbers of 4 or 8 bytes
        size = rng.choice((4, 8))
        place = rng.choice((0, 8, 12, 16, 24, rng.randrange(len(data))))
        return name, data[:place] + (rng.choice(WIDE) % (1 << 8 * size)).to_bytes(size, "little") + data[place + size :]
    if name.endswith(".txt") and rng.random() < 0.5:
        words = data.decode().split(" ")
        words[rng.randrange(len(words))] = rng.choice((*NUMBERS, "", "\n", "#"))
        return name, " ".join(words).encode()
    return name, mutated(data, rng, others)


def make_arrays(rng: Random) -> tuple[str, bytes]:
    name, data, others = _chosen(rng, (".npy",))
    if rng.random() < 0.6:  # another shape, type or order in the header, whose length stays right
        start = 10
        end = start + int.from_bytes(data[8:10], "little")
        header = rng.choice(
            (
                "{'descr': '<f8', 'fortran_order': False, 'shape': (%s, %s), }",
                "{'descr': '<f8', 'fortran_order': True, 'shape': (%s, %s,), }",
                "{'descr': '|O', 'fortran_order': False, 'shape': (%s, %s), }",
                "{'descr': [('a', '<f8', (%s, %s))], 'fortran_order': False, 'shape': (1,), }",
                "{'descr': '|V%s', 'fortran_order': False, 'shape': (%s, 17), }",
                "{'descr': '|S%s', 'fortran_order': False, 'shape': (%s, 3), }",
                "{'descr': '<U%s', 'fortran_order': False, 'shape': (%s, 3), }",
                "{'descr': '<c16', 'fortran_order': False, 'shape': (%s, %s), }",
                "{'descr': ('<f8', (%s,)), 'fortran_order': False, 'shape': (%s, 3), }",
                "{'descr': '<f8', 'fortran_order': False, 'shape': (%s, 17, %s), 'x': 1}",
                "(" * 300 + "%s, %s" + ")" * 300,
            )
        ) % tuple(rng.choice((*map(str, WIDE), "3", "17", "6", "True", "1.5", "'a'", "None")) for _ in range(2))
        text = header.encode()[:60_000] + b"\n"
        data = data[:8] + len(text).to_bytes(2, "little") + text + data[end:]
        return name, data if rng.random() < 0.8 else mutated(data, rng, others)
    return name, mutated(data, rng, others)


def open_folder(folder: Path) -> Path:
    """Every layout with its pictures."""
    picture = next(data for name, data in images.seeds() if name.endswith("png"))
    for layout, files in layouts().items():
        place = "rgb/1x" if layout == "nerfies" else "images"
        for number in range(COUNT):
            _write(folder / layout / place / f"{number:03d}.png", picture)
        for name, data in files.items():
            _write(folder / layout / name, data)
    return folder


def read(folder: Path, name: str, data: bytes) -> None:
    """Put the hostile file in place, load the capture, decode a picture, and restore the file."""
    layout, _, file = name.partition("/")
    path = folder / layout / file
    path.write_bytes(data)
    try:
        capture = load_capture(folder / layout)
        ImageStore((1.0, 1.0, 1.0)).rgb(capture.train[0])
        notes = "\n".join(capture.notes)
        if not notes.replace("\n", "").isprintable() or len(notes) > 10_000:
            raise Damage("notes that cannot be printed")
    finally:
        path.write_bytes(layouts()[layout][file])


def named(name: str) -> tuple[str, ...]:
    """Names that a message may give: the file, the folder of the model, and the pictures that the file describes."""
    layout, _, file = name.partition("/")
    return (file, "sparse/0", "camera", "images/", "rgb/", f"/{layout}:", *layouts()[layout])


def given(folder: Path, name: str) -> Path:
    return folder / name.partition("/")[0]


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
