"""Camera paths: the cameras and times of the frames of a video.

Paths are orbits, splines through views, or files: JSON of keys, or nerfstudio's camera_path.json.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera, View
from graings.camera.orbit import azimuths, one_side
from graings.camera.view_request import MAX_SIDE, ViewRequest
from graings.camera.viewpoint import sized
from graings.errors import CheckpointError
from graings.export.shown import Shown

Moves = Literal["time", "camera", "both"]
ORBIT: Final = "orbit"
VIEWS: Final = "views"
KEYS: Final = 8  # views that a spline passes through

_REMEDY: Final = "docs/export.md has an example."
_REQUEST: Final = {field.name for field in fields(ViewRequest)} - {"background"}


@dataclass(frozen=True, slots=True, eq=False)
class PathKey:
    """A camera (normalised units) and a time in [0, 1], or None where the file names none."""

    camera: Camera
    time: float | None


def frames_of(
    shown: Shown, request: ViewRequest, path: str | Mapping[str, Any] | None, moves: Moves, count: int
) -> list[tuple[Camera, float]]:
    """Camera and time in [0, 1] of `count` frames.

    `path` is `orbit`, once around from the view of `request`, `views`, a closed spline through training views, the name
    of a file, or what such a file holds. None stands for `orbit`, but for `views` if `request` names no viewpoint and
    all training views are on one side of the scene. What does not move stays as in `request`: the camera if `moves` is
    `time`, the time if it is `camera`. The frames of a nerfstudio file are used as they are, whatever `count` is.
    Raises `ValueError` for parameters out of range, `CheckpointError` for a file that cannot be used.
    """
    if count < 1:
        raise ValueError(f"a video needs at least one frame, got {count}")
    if path is None:
        path = ORBIT if request.has_viewpoint or _side(shown) is None else VIEWS
    first, time, _ = request.resolve(shown.views, shown.units, shown.background)
    if moves == "time":
        cameras: list[PathKey] = [PathKey(first, None)] * count
    elif path == ORBIT:
        if not request.is_orbit:
            raise ValueError(
                "an orbit starts at azimuth, elevation and radius; leave out camera and pose, or name a path"
            )
        target = shown.units.center if request.target is None else request.target
        start = float(azimuths(first.center - shown.units.points(target), shown.units.up))
        turned = (replace(request, azimuth=start + 360.0 * index / count) for index in range(count))
        cameras = [PathKey(one.resolve(shown.views, shown.units, shown.background)[0], None) for one in turned]
    elif path == VIEWS:
        chosen = [PathKey(sized(view.camera, request.width, request.height), None) for view in around(shown)]
        cameras = spline(chosen, count, closed=True)
    elif isinstance(path, str):
        cameras = _from_file(Path(path), shown, request, count)
    else:
        cameras = _from_document(path, "path", shown, request, count)
    last = max(1, len(cameras) - 1)
    frames = []
    for index, key in enumerate(cameras):
        own = min(1.0, index / last) if key.time is None else key.time
        frames.append((key.camera, time if moves == "camera" else own))
    return frames


def _side(shown: Shown) -> float | None:
    """Mean azimuth in degrees of the training views about the scene's centre if they are on one side of it."""
    return one_side(np.stack([view.camera.center for view in shown.views["train"]]), shown.units.up)


def around(shown: Shown) -> list[View]:
    """Up to `KEYS` training views in the order of their azimuth, and back again if they are on one side."""
    middle = _side(shown)

    def place(view: View) -> float:
        return math.remainder(float(azimuths(view.camera.center, shown.units.up)) - (middle or 0.0), 360.0)

    views = sorted(shown.views["train"], key=place)
    kept = min(KEYS, len(views))
    chosen = [views[index * len(views) // kept] for index in range(kept)]
    return chosen if middle is None else chosen + chosen[-2:0:-1]


def spline(keys: Sequence[PathKey], count: int, *, closed: bool = False) -> list[PathKey]:
    """`count` cameras along a Catmull-Rom spline through `keys`, at equal distances of the parameter.

    Positions, rotations (projected onto the nearest rotation), log focal lengths and times are interpolated; the image
    size is that of the first key. A closed spline returns to its first key without repeating it.
    """
    poses = [np.linalg.inv(key.camera.world_to_camera) for key in keys]
    size = keys[0].camera
    lenses = [_lens(key.camera, size) for key in keys]
    rows = np.stack([np.concatenate([p[:3].ravel(), lens]) for p, lens in zip(poses, lenses, strict=True)])
    timed = all(key.time is not None for key in keys)
    times = np.array([key.time for key in keys], dtype=np.float64) if timed else None
    segments = len(keys) if closed else len(keys) - 1
    found = []
    for index in range(count):
        place = segments * index / (count if closed else max(1, count - 1))
        row = _catmull_rom(rows, place, closed)
        left, _, right = np.linalg.svd(row[:12].reshape(3, 4)[:, :3])
        pose = np.eye(4)
        pose[:3, :3] = (left * [1, 1, np.linalg.det(left @ right)] @ right).T
        pose[:3, 3] = -pose[:3, :3] @ row[:12].reshape(3, 4)[:, 3]
        fx, fy = np.exp(row[12:14])
        camera = Camera(pose, float(fx), float(fy), float(row[14]), float(row[15]), size.width, size.height)
        moment = None if times is None else float(np.interp(place, np.arange(len(keys)), times))
        found.append(PathKey(camera, moment))
    return found


def _lens(camera: Camera, size: Camera) -> NDArray[np.float64]:
    """Log focal lengths and principal point at the image size of `size`."""
    camera = camera.resized(size.width, size.height)
    return np.array([math.log(camera.fx), math.log(camera.fy), camera.cx, camera.cy])


def _catmull_rom(rows: NDArray[np.float64], place: float, closed: bool) -> NDArray[np.float64]:
    count = len(rows)
    start = min(int(place), count - 1 if closed else max(0, count - 2))
    u = place - start
    p, q, r, s = (rows[(start + k) % count if closed else min(max(start + k, 0), count - 1)] for k in (-1, 0, 1, 2))
    found: NDArray[np.float64] = q + 0.5 * u * (r - p + u * (2 * p - 5 * q + 4 * r - s + u * (3 * (q - r) + s - p)))
    return found


def _from_file(path: Path, shown: Shown, request: ViewRequest, count: int) -> list[PathKey]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: no camera path ({error}). {_REMEDY}") from error
    return _from_document(document, str(path), shown, request, count)


def _from_document(document: Any, name: str, shown: Shown, request: ViewRequest, count: int) -> list[PathKey]:
    try:
        if not isinstance(document, dict):
            raise ValueError("must be a JSON object")
        if "camera_path" in document:
            return _nerfstudio(document, shown, request)
        if not isinstance(document.get("keys"), list) or not document["keys"]:
            raise ValueError("needs a list of keys, or nerfstudio's camera_path")
        keys = [_key(entry, shown, request) for entry in document["keys"]]
        if any((key.time is None) != (keys[0].time is None) for key in keys):
            raise ValueError("give t for every key or for none")
        return spline(keys, count, closed=bool(document.get("closed", False)))
    except (ValueError, TypeError, KeyError, ArithmeticError) as error:
        raise CheckpointError(f"{name}: no camera path ({error}). {_REMEDY}") from error


def _key(entry: dict[str, Any], shown: Shown, request: ViewRequest) -> PathKey:
    """A key is what `ViewRequest` takes: a named view, an orbit or a pose, and `t`."""
    unknown = set(entry) - _REQUEST
    if unknown:
        raise ValueError(f"a key has no {', '.join(sorted(unknown))}; it has {', '.join(sorted(_REQUEST))}")
    size = {"width": request.width, "height": request.height}
    camera, time, _ = ViewRequest(**size | entry).resolve(shown.views, shown.units, shown.background)
    return PathKey(camera, time if "t" in entry else None)


def _nerfstudio(document: dict[str, Any], shown: Shown, request: ViewRequest) -> list[PathKey]:
    """Every frame of a camera_path.json: camera_to_world (4x4, OpenGL axes) and the vertical field of view."""
    width, height = int(document["render_width"]), int(document["render_height"])
    if not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
        raise ValueError(f"render_width and render_height must lie from 1 to {MAX_SIDE}, got {width} x {height}")
    keys = []
    for entry in document["camera_path"]:
        pose = np.array(entry["camera_to_world"], dtype=np.float64).reshape(4, 4)
        pose[:3, 1:3] *= -1  # OpenGL: y up, z backward
        fov = float(entry["fov"])
        if not 0 < fov < 180:
            raise ValueError(f"fov must lie between 0 and 180 degrees, got {fov}")
        focal = 0.5 * height / math.tan(math.radians(fov) / 2)
        matrix = shown.units.camera(np.linalg.inv(pose))
        camera = Camera(matrix, focal, focal, width / 2, height / 2, width, height)
        time = entry.get("render_time")
        keys.append(PathKey(sized(camera, request.width, request.height), None if time is None else float(time)))
    if not keys:
        raise ValueError("camera_path is empty")
    return keys
