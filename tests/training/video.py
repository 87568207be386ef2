"""A painted board that crosses in front of a painted floor, as a moving camera sees it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera
from tests.capture.captures import FOV, entry, interpolated, write_image

WIDTH: Final = 320
HEIGHT: Final = 240
FRAMES: Final = 20
BOARD_HEIGHT: Final = 0.15
HALF: Final = 0.45  # half the side of the board

Array = NDArray[np.float64]


def camera(time: float) -> Camera:
    """From above; it moves sideways by a tenth of its distance."""
    return Camera.look_at((0.4 * time - 0.2, -1.0, 3.5), (0.0, 0.0, 0.0), fov=FOV, width=WIDTH, height=HEIGHT)


def on_board(places: Array, time: float, travel: float) -> Array:
    """Points [N, 3] of the world at `time` of places [N, 2] on the board, which goes by `travel` and turns."""
    angle = 0.6 * (time - 0.5)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    flat = places @ turn.T + [travel * (time - 0.5), 0.0]
    return np.column_stack([flat, np.full(len(flat), BOARD_HEIGHT)])


def off_board(points: Array, time: float, travel: float) -> Array:
    """The inverse of `on_board`: places [N, 2] of points [N, 3], whatever their height is."""
    angle = 0.6 * (time - 0.5)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    places: Array = (points[:, :2] - [travel * (time - 0.5), 0.0]) @ turn
    return places


def write_video(folder: Path, travel: float, frames: int = FRAMES, paint: bool = True) -> Path:
    """A capture with a point cloud of the floor. The board goes by `travel`; without `paint` it has one colour."""
    random = np.random.default_rng(0)
    floor, board = random.random((64, 64, 3)), random.random((64, 64, 3))
    entries = []
    for index in range(frames):
        time = index / (frames - 1)
        view = camera(time)
        u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        towards = np.stack([(u - view.cx) / view.fx, (v - view.cy) / view.fy, np.ones_like(u)], axis=-1)
        towards = towards @ view.world_to_camera[:3, :3]
        ground = view.center - view.center[2] / towards[..., 2:] * towards
        image = interpolated(floor, 20.0 * ground[..., 0], 20.0 * ground[..., 1])
        above = view.center + (BOARD_HEIGHT - view.center[2]) / towards[..., 2:] * towards
        place = off_board(above.reshape(-1, 3), time, travel).reshape(HEIGHT, WIDTH, 2)
        hit = (np.abs(place) < HALF).all(axis=-1)
        image[hit] = interpolated(board, 20.0 * place[..., 0], 20.0 * place[..., 1])[hit] if paint else 0.5
        write_image(folder / f"images/{index:03d}.png", np.rint(255 * image).astype(np.uint8))
        entries.append(entry(view, f"images/{index:03d}.png", time))
    places = random.uniform(-1.3, 1.3, (2000, 2))
    rows = "\n".join(f"{x:.6f} {y:.6f} 0 128 128 128" for x, y in places)
    kinds = "".join(f"property float {axis}\n" for axis in "xyz")
    kinds += "".join(f"property uchar {channel}\n" for channel in ("red", "green", "blue"))
    head = f"ply\nformat ascii 1.0\nelement vertex {len(places)}\n{kinds}end_header\n"
    (folder / "points.ply").write_text(head + rows + "\n")
    lens = {"fl_x": view.fx, "fl_y": view.fy, "cx": view.cx, "cy": view.cy, "w": WIDTH, "h": HEIGHT}
    document = {**lens, "ply_file_path": "points.ply", "frames": entries}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder
