"""path_file: the cameras of a path in a file: JSON of keys that a spline connects, or nerfstudio's camera_path.json."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from graings.camera.camera import Camera
from graings.camera.view_request import MAX_SIDE, ViewRequest
from graings.camera.viewpoint import sized
from graings.errors import CheckpointError
from graings.export.shown import Shown
from graings.export.spline import PathKey, spline

_REMEDY: Final = "docs/export.md has an example."
_REQUEST: Final = {field.name for field in fields(ViewRequest)} - {"background"}
# Types of a key's values. ViewRequest, which takes them as they are, looks only whether they are in range.
_NUMBERS: Final = ("azimuth", "elevation", "radius", "fov", "t")
_OTHERS: Final[dict[str, tuple[type, str]]] = {
    "camera": (str, "a name such as train:3"),
    "target": (list, "three numbers"),
    "pose": (dict, "an object with world_to_camera, fx, width and height"),
    "width": (int, "a whole number"),
    "height": (int, "a whole number"),
}


def read_path(path: Path, shown: Shown, request: ViewRequest, count: int) -> list[PathKey]:
    """The cameras in the file `path`, as `path_keys`. Raises `OSError` for a file that cannot be read."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: no camera path ({error}). {_REMEDY}") from error
    return path_keys(document, str(path), shown, request, count)


def path_keys(document: Any, name: str, shown: Shown, request: ViewRequest, count: int) -> list[PathKey]:
    """`count` cameras along the keys of `document`, or one for each frame of nerfstudio's.

    Image sizes are those of `request` where it names some. Raises `CheckpointError` with `name` and the key.
    """
    try:
        if not isinstance(document, dict):
            raise ValueError("must be a JSON object")
        if "camera_path" in document:
            return _nerfstudio(document, shown, request)
        if not isinstance(document.get("keys"), list) or not document["keys"]:
            raise ValueError("needs a list of keys, or nerfstudio's camera_path")
        keys = [_key(f"keys[{index}]", entry, shown, request) for index, entry in enumerate(document["keys"])]
        if any((key.time is None) != (keys[0].time is None) for key in keys):
            raise ValueError("give t for every key or for none")
        closed = document.get("closed", False)
        if not isinstance(closed, bool):
            raise ValueError(f"closed must be true or false, got {closed!r:.40}")
        return spline(keys, count, closed=closed)
    except (ValueError, ArithmeticError) as error:
        raise CheckpointError(f"{name}: no camera path ({error}). {_REMEDY}") from error


def _key(name: str, entry: Any, shown: Shown, request: ViewRequest) -> PathKey:
    """A key is what `ViewRequest` takes: a named view, an orbit or a pose, and `t`."""
    if not isinstance(entry, dict):
        raise ValueError(f"{name} must be an object, got {entry!r:.40}")
    unknown = set(entry) - _REQUEST
    if unknown:
        raise ValueError(f"{name} has no {', '.join(sorted(unknown))}; a key has {', '.join(sorted(_REQUEST))}")
    given = {key: value for key, value in entry.items() if value is not None}
    for key, value in given.items():
        if key in _NUMBERS:
            _number(name, key, value)
        elif not isinstance(value, _OTHERS[key][0]) or isinstance(value, bool):
            raise ValueError(f"{name}: {key} must be {_OTHERS[key][1]}, got {value!r:.40}")
    size = {"width": request.width, "height": request.height}
    try:
        camera, time, _ = ViewRequest(**size | given).resolve(shown.views, shown.units, shown.background)
    except (ValueError, TypeError, ArithmeticError) as error:
        raise ValueError(f"{name}: {error}") from error
    return PathKey(camera, time if "t" in given else None)


def _number(name: str, key: str, value: Any) -> float:
    """A value of a file. Raises `ValueError`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"{name}: {key} must be a finite number, got {value!r:.40}")
    return float(value)


def _nerfstudio(document: dict[str, Any], shown: Shown, request: ViewRequest) -> list[PathKey]:
    """Every frame of a camera_path.json: camera_to_world (4x4, OpenGL axes) and the vertical field of view."""
    if (kind := document.get("camera_type", "perspective")) != "perspective":
        raise ValueError(f"camera_type must be perspective, got {kind!r:.40}")
    sides = ("render_width", "render_height")
    width, height = (int(_number("camera_path", side, document.get(side))) for side in sides)
    if not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
        raise ValueError(f"render_width and render_height must lie from 1 to {MAX_SIDE}, got {width} x {height}")
    entries = document["camera_path"]
    if not isinstance(entries, list) or not entries:
        raise ValueError("camera_path must be a list of frames" + ("" if entries else ", and is empty"))
    keys = []
    for index, entry in enumerate(entries):
        name = f"camera_path[{index}]"
        missing = {"camera_to_world", "fov"} - set(entry if isinstance(entry, dict) else ())
        if missing:
            raise ValueError(f"{name} has no {', '.join(sorted(missing))}")
        fov, time = _number(name, "fov", entry["fov"]), entry.get("render_time")
        if not 0 < fov < 180:
            raise ValueError(f"{name}: fov must lie between 0 and 180 degrees, got {fov}")
        focal = 0.5 * height / math.tan(math.radians(fov) / 2)
        try:
            pose = np.array(entry["camera_to_world"], dtype=np.float64).reshape(4, 4)
            pose[:3, 1:3] *= -1  # OpenGL: y up, z backward
            matrix = shown.units.camera(np.linalg.inv(pose))
            camera = Camera(matrix, focal, focal, width / 2, height / 2, width, height)
        except (ValueError, TypeError, ArithmeticError) as error:
            raise ValueError(f"{name}: camera_to_world is no pose ({error})") from error
        moment = None if time is None else min(1.0, max(0.0, _number(name, "render_time", time)))
        keys.append(PathKey(sized(camera, request.width, request.height), moment))
    return keys
