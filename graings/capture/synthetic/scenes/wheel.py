"""Wheel: a Ferris wheel with thin spokes, wires and hanging cabins."""

from __future__ import annotations

from collections.abc import Callable

from graings.capture.synthetic.exact import cosine, sine
from graings.capture.synthetic.pose import Pose, along, at
from graings.capture.synthetic.scenes.plate import plate
from graings.capture.synthetic.shapes import Ball, Box, Hoop, RoundCone, Spokes
from graings.capture.synthetic.textures import Layered, Plain, rgb
from graings.capture.synthetic.world import CameraPath, Part, World

CENTER = (0.0, 0.0, 0.12)
RADIUS, DEPTH, TURNS = 0.78, 0.11, 0.3
CABINS = 8


def _wheel(side: float) -> Callable[[float], Pose]:
    # The wheel's axis is y: body z is turned onto it.
    return lambda time: at(*CENTER).moved(0.0, side * DEPTH, 0.0).turned("x", 0.25).turned("z", TURNS * time)


def _cabin(index: int) -> Callable[[float], Pose]:
    def pose(time: float) -> Pose:
        angle = index / CABINS - TURNS * time
        x, z = RADIUS * cosine(angle), RADIUS * sine(angle)
        swing = 0.03 * sine(3.0 * time + 0.13 * index)
        return at(CENTER[0] + x, 0.0, CENTER[2] + z).turned("y", swing)

    return pose


def _below(pose: Callable[[float], Pose], distance: float) -> Callable[[float], Pose]:
    return lambda time: pose(time).moved(0.0, 0.0, -distance)


def _axle(pose: Callable[[float], Pose]) -> Callable[[float], Pose]:
    """A rod between the two rims, on which a cabin hangs."""
    return lambda time: pose(time).moved(0.0, -0.1, 0.0).turned("x", -0.25)


def _rod(start: tuple[float, float, float], end: tuple[float, float, float], radius: float, color: str) -> Part:
    pose, length = along(start, end)
    return Part(RoundCone(length, radius, radius), Plain(rgb(color)), pose=lambda time: pose, gloss=0.2)


def build(seed: int) -> World:
    """The world of a seed."""
    white, red = Plain(rgb("f1ede4")), Plain(rgb("c8372d"))
    parts = [plate(-0.98, 0.95), Part(Ball(0.07), red, pose=lambda time: at(*CENTER), gloss=0.3)]
    for side in (-1.0, 1.0):
        parts += [
            Part(Hoop(RADIUS, 0.016), red, pose=_wheel(side), moves=True, gloss=0.2),
            Part(Hoop(0.6 * RADIUS, 0.010), white, pose=_wheel(side), moves=True),
            Part(Spokes(0.03, RADIUS, 0.0095, 3), white, pose=_wheel(side), moves=True),
            _rod((-0.5, side * 0.3, -0.96), (0.0, side * 0.17, 0.12), 0.024, "3b5b86"),
            _rod((0.5, side * 0.3, -0.96), (0.0, side * 0.17, 0.12), 0.024, "3b5b86"),
            _rod((0.0, side * 0.85, -0.95), (0.0, side * 0.17, 0.12), 0.008, "55595f"),  # a wire
        ]
    colors = ("e8a33d", "3f8f6b", "4a78b5", "b0487a")
    for index in range(CABINS):
        pose = _cabin(index)
        tub = Layered(Plain(rgb(colors[index % 4])), Plain(rgb("f4efe2")), 2, 0.02)
        parts += [
            Part(
                RoundCone(0.2, 0.012, 0.012),
                white,
                pose=_axle(pose),
                moves=True,
            ),
            Part(Box((0.085, 0.075, 0.065), 0.03), tub, pose=_below(pose, 0.13), moves=True, gloss=0.1),
        ]
    return World(tuple(parts), CameraPath(distance=4.1, elevation=(0.01, 0.11), target=(0.0, 0.0, -0.1)))
