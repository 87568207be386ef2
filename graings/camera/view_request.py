"""ViewRequest: the parameters of a view as a person gives them, and their camera, time and background.

The command line and the service both resolve their parameters here, with the same defaults and limits.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from graings.camera.camera import Camera, View
from graings.camera.units import Units
from graings.camera.viewpoint import background_rgb, named_view, orbit_view, pose_camera, sized

Color = tuple[float, float, float]

# Width and height of a rendered image, in px. It covers full-frame cameras (8192 x 5464), and 8192 x 8192 px of float32
# colour take 0.8 GB.
MAX_SIDE: Final = 8192
ORBIT: Final = ("azimuth", "elevation", "radius", "target", "fov")


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewRequest:
    """At most one of a named view (`camera`), an orbit and a pose; without any, an orbit with default values.

    Angles are in degrees, lengths in the capture's units, sizes in px. `camera`, the orbit and `width`, `height` are as
    in `graings.camera.viewpoint`. `pose` has the values `world_to_camera` ([4, 4], OpenCV axes), `fx`, `width` and
    `height`, and may have `fy` (default `fx`), `cx` and `cy` (default: the middle). None stands for the default.
    """

    camera: str | None = None
    azimuth: float | None = None
    elevation: float | None = None
    radius: float | None = None
    target: Sequence[float] | None = None
    fov: float | None = None
    pose: Mapping[str, object] | None = None
    width: int | None = None
    height: int | None = None
    t: float | None = None
    background: str | None = None

    @property
    def is_orbit(self) -> bool:
        """Whether neither a named view nor a pose is given."""
        return self.camera is None and self.pose is None

    @property
    def has_viewpoint(self) -> bool:
        """Whether a named view, a pose or a value of an orbit is given."""
        return any(getattr(self, name) is not None for name in ("camera", "pose", *ORBIT))

    def resolve(
        self, views: Mapping[str, Sequence[View]], units: Units, background: Color
    ) -> tuple[Camera, float, Color]:
        """Normalised camera, time in [0, 1] and background RGB in [0, 1].

        `views` are those of the model by split, `background` is the default. A time outside is clamped; the default is
        that of the named view, or 0. Raises `ValueError` naming the parameter.
        """
        self._check_kind()
        if self.t is not None and not math.isfinite(self.t):
            raise ValueError(f"t must be a number from 0 to 1, got {self.t}")
        color = background if self.background is None else background_rgb(self.background)
        time = 0.0
        if self.camera is not None:
            view = named_view(views, self.camera)
            camera, time = sized(view.camera, self.width, self.height), view.time
        elif self.pose is not None:
            camera = sized(_pose_camera(self.pose, units), self.width, self.height)
        else:
            around = views.get("train", ())
            orbit = (self.azimuth, self.elevation, self.radius, self.target, self.fov)
            camera = orbit_view(around, units, *orbit, self.width, self.height)
        if max(camera.width, camera.height) > MAX_SIDE:
            size = f"{camera.width}x{camera.height}"
            raise ValueError(f"width and height must be at most {MAX_SIDE} pixels, got {size}; give a smaller one")
        return camera, min(1.0, max(0.0, time if self.t is None else self.t)), color

    def _check_kind(self) -> None:
        kinds = (("camera",), ORBIT, ("pose",))
        given = [names for kind in kinds if (names := [name for name in kind if getattr(self, name) is not None])]
        if len(given) > 1:
            together = ", ".join(name for names in given for name in names)
            raise ValueError(f"choose one viewpoint: a view, an orbit or a pose, not {together} together")


def _pose_camera(pose: Mapping[str, object], units: Units) -> Camera:
    missing = [key for key in ("world_to_camera", "fx", "width", "height") if pose.get(key) is None]
    if missing:
        raise ValueError(f"pose: {', '.join(missing)} missing; a pose needs world_to_camera, fx, width and height")
    width, height = _side(pose, "width"), _side(pose, "height")
    fx = _number(pose, "fx", 0.0)
    fy, cx, cy = _number(pose, "fy", fx), _number(pose, "cx", width / 2), _number(pose, "cy", height / 2)
    try:
        matrix = np.asarray(pose["world_to_camera"], dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"pose: world_to_camera must be four rows of four numbers ({error})") from error
    return pose_camera(units, matrix, fx, fy, cx, cy, width, height)


def _side(pose: Mapping[str, object], key: str) -> int:
    side = pose[key]
    if type(side) is not int or not 1 <= side <= MAX_SIDE:
        raise ValueError(f"pose: {key} must be a whole number from 1 to {MAX_SIDE}, got {side!r}")
    return side


def _number(pose: Mapping[str, object], key: str, default: float) -> float:
    value = pose.get(key)
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"pose: {key} must be a finite number, got {value!r:.40}")
    return float(value)
