"""Camera paths: the cameras and times of the frames of a video.

Paths are orbits, splines through views, or files (`graings.export.path_file`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from graings.camera.camera import Camera, View
from graings.camera.orbit import azimuths, one_side
from graings.camera.view_request import ORBIT as ORBIT_VALUES
from graings.camera.view_request import ViewRequest
from graings.camera.viewpoint import sized
from graings.export.path_file import path_keys, read_path
from graings.export.shown import Shown
from graings.export.spline import PathKey, spline

Moves = Literal["time", "camera", "both"]
ORBIT: Final = "orbit"
VIEWS: Final = "views"
KEYS: Final = 8  # views that a spline passes through


def frames_of(
    shown: Shown, request: ViewRequest, path: str | Mapping[str, Any] | None, moves: Moves, count: int
) -> list[tuple[Camera, float]]:
    """Camera and time in [0, 1] of `count` frames.

    `path` is `orbit`, once around from the view of `request`, `views`, a closed spline through training views, the name
    of a file, or what such a file holds. None stands for `orbit`, but for `views` if `request` names no viewpoint and
    the training views, two or more, are all on one side of the scene. What does not move stays as in `request`: the
    camera if `moves` is `time`, the time if it is `camera`. The frames of a nerfstudio file are used as they are,
    whatever `count` is. Raises `ValueError` for parameters out of range and for those that would have no effect,
    `CheckpointError` for a file that cannot be used.
    """
    if count < 1:
        raise ValueError(f"a video needs at least one frame, got {count}")
    _check_used(request, path, moves)
    if path is None:
        several = len(shown.views["train"]) > 1  # a file of splats has one view, which somebody made up
        path = VIEWS if several and not request.has_viewpoint and _side(shown) is not None else ORBIT
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
        cameras = read_path(Path(path), shown, request, count)
    else:
        cameras = path_keys(path, "path", shown, request, count)
    last = max(1, len(cameras) - 1)
    frames = []
    for index, key in enumerate(cameras):
        own = min(1.0, index / last) if key.time is None else key.time
        frames.append((key.camera, time if moves == "camera" else own))
    return frames


def _check_used(request: ViewRequest, path: str | Mapping[str, Any] | None, moves: Moves) -> None:
    """Raises `ValueError` for a value that would have no effect."""
    if request.t is not None and moves != "camera":
        raise ValueError("t is the time while only the camera moves, and here time runs; leave it out, or move camera")
    if path is not None and moves == "time":
        raise ValueError("path is for a camera that moves, and here only time does; leave it out, or move both")
    if path is not None and path != ORBIT:
        given = [name for name in ("camera", "pose", *ORBIT_VALUES) if getattr(request, name) is not None]
        if given:
            raise ValueError(f"path has its own viewpoints, so {', '.join(given)} would have no effect; leave out one")


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
