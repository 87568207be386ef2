"""Viewpoint: cameras and backgrounds from the parameters of a command or an HTTP request.

Parameters are in the capture's own units, angles in degrees; the camera is in normalised units
(`graings.camera.units`). Missing parameters are taken from the training views.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from graings.camera.camera import Camera, Vector, View
from graings.camera.orbit import elevations, one_side
from graings.camera.units import Units

# Bounds of an orbit's radius in normalised units; beyond them rounding makes the camera's position meaningless.
MIN_DISTANCE, MAX_DISTANCE = 1e-9, 1e9
# Radius where the training views look around from the centre of the scene, normalised units.
MIN_ORBIT = 0.01


def orbit_view(
    model_views: Sequence[View],
    units: Units,
    azimuth: float | None = None,
    elevation: float | None = None,
    radius: float | None = None,
    target: ArrayLike | None = None,
    fov: float | None = None,
    width: int | None = None,
    height: int | None = None,
) -> Camera:
    """A camera on a sphere around `target`, looking at it.

    `azimuth` is about the capture's vertical axis, `elevation` above the horizon, both in degrees; `radius` and
    `target` [3] are in capture units, `fov` is the full horizontal angle in degrees. Defaults: the side where the
    cameras of `model_views` stand, or azimuth 0 if they stand all around; their median radius (0.01 normalised units
    at least) and elevation; the scene's centre; the field of view and size of the first view.
    Raises `ValueError` naming the parameter.
    """
    if not model_views:
        raise ValueError("an orbit takes its defaults from the training views, and there are none")
    aim = _point("target", units.center if target is None else target)
    if any(abs(x - c) > MAX_DISTANCE / units.scale for x, c in zip(aim, units.center, strict=True)):
        raise ValueError(
            f"target must lie within {MAX_DISTANCE / units.scale:g} of the scene's centre, got {list(aim)}"
        )
    aim_normalised = units.points(aim)
    up = np.asarray(units.up, dtype=np.float64)
    arms = np.stack([view.camera.center for view in model_views]) - aim_normalised
    lengths = np.linalg.norm(arms, axis=1)
    if radius is None:
        radius = max(float(np.median(lengths)), MIN_ORBIT) / units.scale
    if elevation is None:
        elevation = float(np.median(elevations(arms, up)))
    if azimuth is None:
        azimuth = one_side(arms, up) or 0.0
    first = model_views[0].camera
    fov = math.degrees(first.horizontal_fov) if fov is None else fov
    for name, value in (("azimuth", azimuth), ("elevation", elevation), ("radius", radius), ("fov", fov)):
        if not math.isfinite(value):
            raise ValueError(f"{name} must be finite, got {value}")
    if not -90.0 <= elevation <= 90.0:
        raise ValueError(f"elevation must lie in [-90, 90] degrees, got {elevation:g}")
    if not MIN_DISTANCE / units.scale <= radius <= MAX_DISTANCE / units.scale:
        least, most = MIN_DISTANCE / units.scale, MAX_DISTANCE / units.scale
        raise ValueError(f"radius must lie between {least:g} and {most:g}, got {radius:g}")
    if not 0.0 < fov < 180.0:
        raise ValueError(f"fov must lie in (0, 180) degrees, got {fov:g}")
    width_, height_ = _size(first, width, height)
    return Camera.orbit(
        azimuth,
        elevation,
        radius * units.scale,
        target=aim_normalised,
        up=up,
        fov=math.radians(fov),
        width=width_,
        height=height_,
    )


def named_view(views: Mapping[str, Sequence[View]], name: str) -> View:
    """The view called `split:index`, such as `test:3`, counted from 0. Raises `ValueError` naming those that exist."""
    split, colon, index = name.partition(":")
    if not colon or not (index.isascii() and index.isdigit()):
        raise ValueError(f"camera must look like split:index, for example train:0, got {name!r}")
    if split not in views:
        raise ValueError(f"camera {name!r}: there is no split {split!r}, only {', '.join(views)}")
    chosen = views[split]
    if int(index) >= len(chosen):
        have = f"its views are {split}:0 to {split}:{len(chosen) - 1}" if chosen else "it has no views"
        raise ValueError(f"camera {name!r}: the index is out of range; {have}")
    return chosen[int(index)]


def pose_camera(
    units: Units, pose: ArrayLike, fx: float, fy: float, cx: float, cy: float, width: int, height: int
) -> Camera:
    """A camera from a world-to-camera pose [4, 4] (OpenCV axes, capture units) and intrinsics in pixels."""
    matrix = np.asarray(pose, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"pose must have shape (4, 4), got {matrix.shape}")
    return Camera(units.camera(matrix), fx, fy, cx, cy, width, height)


def sized(camera: Camera, width: int | None = None, height: int | None = None) -> Camera:
    """The same viewpoint at another image size.

    Width or height alone keeps the aspect ratio. Both together keep the horizontal field of view and crop or extend
    the image vertically, so that the pixel aspect ratio stays the same.
    """
    width_, height_ = _size(camera, width, height)
    zoom = width_ / camera.width
    cy = 0.5 * height_ + zoom * (camera.cy - 0.5 * camera.height)
    pose = camera.world_to_camera
    return Camera(pose, zoom * camera.fx, zoom * camera.fy, zoom * camera.cx, cy, width_, height_)


def background_rgb(text: str) -> tuple[float, float, float]:
    """A background from `white`, `black`, `#rrggbb` or three numbers in [0, 1] such as `0.5,0.5,0.5`."""
    named = {"white": "#ffffff", "black": "#000000"}.get(text.strip().lower(), text.strip())
    try:
        if named.startswith("#") and len(named) == 7:
            values = [byte / 255.0 for byte in bytes.fromhex(named[1:])]
        else:
            values = [float(part) for part in named.split(",")]
    except ValueError:
        values = []
    if len(values) != 3 or not all(0.0 <= value <= 1.0 for value in values):
        raise ValueError(f"background must be white, black, #rrggbb or r,g,b in [0, 1], got {text!r}")
    return values[0], values[1], values[2]


def _size(camera: Camera, width: int | None, height: int | None) -> tuple[int, int]:
    for name, value in (("width", width), ("height", height)):
        if value is not None and value < 1:
            raise ValueError(f"{name} must be at least 1 pixel, got {value}")
    if width is None:
        width = camera.width if height is None else max(1, round(camera.width * height / camera.height))
    if height is None:
        height = max(1, round(camera.height * width / camera.width))
    return width, height


def _point(name: str, value: ArrayLike) -> Vector:
    point = np.asarray(value, dtype=np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"{name} must be three finite numbers, got {value!r}")
    return point
