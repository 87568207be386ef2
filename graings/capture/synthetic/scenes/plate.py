"""The round plate that scenes without a room stand on."""

from __future__ import annotations

from collections.abc import Callable

from graings.capture.synthetic.exact import Vector
from graings.capture.synthetic.pose import Pose, at
from graings.capture.synthetic.shapes import Disc
from graings.capture.synthetic.textures import Checker, Texture, rgb
from graings.capture.synthetic.world import Part

HALF = 0.04


def plate(top: float, radius: float = 1.05, texture: Texture | None = None) -> Part:
    """A plate whose upper side is at height `top`."""
    pose = at(0.0, 0.0, top - HALF)
    pattern = texture or Checker(rgb("b9b2a6"), rgb("e6e0d4"), (0, 1), 0.5)
    return Part(Disc(radius, HALF), pattern, pose=lambda time: pose)


def resting(place: Vector, turns: float = 0.0) -> Callable[[float], Pose]:
    """Pose function of a body that rests at a place, turned about the vertical."""
    pose = at(*place).turned("z", turns)
    return lambda time: pose
