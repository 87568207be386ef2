"""Walker: a figure of round limbs that jumps, swings its arms and kicks while it turns."""

from __future__ import annotations

from collections.abc import Callable

from graings.capture.synthetic.exact import cosine, sine
from graings.capture.synthetic.pose import Pose, at
from graings.capture.synthetic.scenes.plate import plate
from graings.capture.synthetic.shapes import Ball, RoundCone, Shape
from graings.capture.synthetic.textures import Layered, Plain, Stripes, Texture, rgb
from graings.capture.synthetic.world import CameraPath, Part, World

CYCLES = 2.0
SKIN, SHIRT, DARK = rgb("e2a57e"), rgb("d8432f"), rgb("26344d")


def _root(time: float) -> Pose:
    bounce = 0.09 * (1.0 - cosine(2.0 * CYCLES * time))
    return at(0.0, 0.0, -0.12 + bounce).turned("z", 0.12 * sine(time) - 0.25)


def _chest(time: float) -> Pose:
    return (
        _root(time).moved(0.0, 0.0, 0.1).turned("y", 0.03 * sine(CYCLES * time)).turned("z", 0.04 * sine(CYCLES * time))
    )


def _arm(side: float) -> Callable[[float], Pose]:
    def pose(time: float) -> Pose:
        lift = 0.06 + 0.2 * (1.0 - cosine(CYCLES * time))  # turns away from hanging down
        swing = 0.10 * side * sine(CYCLES * time)
        return (
            _chest(time)
            .moved(0.0, 0.22 * side, 0.34)
            .turned("y", swing)
            .turned("x", 0.5 * side)
            .turned("x", side * lift)
        )

    return pose


def _forearm(side: float) -> Callable[[float], Pose]:
    def pose(time: float) -> Pose:
        return _arm(side)(time).moved(0.0, 0.0, 0.3).turned("x", side * (0.05 + 0.06 * sine(2.0 * CYCLES * time)))

    return pose


def _leg(side: float) -> Callable[[float], Pose]:
    def pose(time: float) -> Pose:
        spread = 0.03 + 0.035 * (1.0 - cosine(CYCLES * time))
        kick = 0.10 * side * sine(CYCLES * time + 0.1)
        return _root(time).moved(0.0, 0.1 * side, -0.04).turned("x", 0.5 * side + side * spread).turned("y", kick)

    return pose


def _shin(side: float) -> Callable[[float], Pose]:
    def pose(time: float) -> Pose:
        bend = 0.045 * (1.0 + sine(CYCLES * time + (0.0 if side > 0 else 0.5)))
        return _leg(side)(time).moved(0.0, 0.0, 0.36).turned("y", bend)

    return pose


def _after(pose: Callable[[float], Pose], x: float, y: float, z: float) -> Callable[[float], Pose]:
    return lambda time: pose(time).moved(x, y, z)


def build(seed: int) -> World:
    """The world of a seed."""

    def limb(shape: Shape, texture: Texture, pose: Callable[[float], Pose]) -> Part:
        return Part(shape, texture, pose=pose, moves=True, gloss=0.05)

    shirt = Stripes(SHIRT, rgb("f4efe4"), (0.0, 0.0, 1.0), 0.13, 0.2)
    head = Layered(Plain(SKIN), Plain(rgb("4a2f1d")), 2, 0.06, 0.03)
    parts = [
        plate(-0.93, 0.8),
        limb(RoundCone(0.12, 0.14, 0.15), Plain(DARK), _root),
        limb(RoundCone(0.26, 0.15, 0.19), shirt, _chest),
        limb(RoundCone(0.16, 0.07, 0.06), Plain(SKIN), _after(_chest, 0.0, 0.0, 0.4)),
        limb(Ball(0.165), head, _after(_chest, 0.0, 0.0, 0.66)),
        limb(Ball(0.035), Plain(rgb("c9805c")), _after(_chest, 0.165, 0.0, 0.64)),
    ]
    for side in (-1.0, 1.0):
        parts += [
            limb(RoundCone(0.3, 0.085, 0.065), shirt, _arm(side)),
            limb(RoundCone(0.27, 0.062, 0.05), Plain(SKIN), _forearm(side)),
            limb(Ball(0.075), Plain(rgb("f2c230")), _after(_forearm(side), 0.0, 0.0, 0.32)),
            limb(RoundCone(0.36, 0.115, 0.085), Plain(DARK), _leg(side)),
            limb(RoundCone(0.32, 0.08, 0.055), Stripes(DARK, rgb("3f5f8c"), (0.0, 0.0, 1.0), 0.11), _shin(side)),
            limb(RoundCone(0.14, 0.07, 0.05), Plain(rgb("f2c230")), _foot(side)),
        ]
    return World(tuple(parts), CameraPath(distance=3.9, target=(0.0, 0.0, -0.08)))


def _foot(side: float) -> Callable[[float], Pose]:
    return lambda time: _shin(side)(time).moved(-0.02, 0.0, 0.34).turned("y", 0.27)
