"""Rig: three balls are juggled before twelve fixed cameras, each of which sees every instant."""

from __future__ import annotations

import math
from collections.abc import Callable

from graings.capture.synthetic.exact import cosine, sine
from graings.capture.synthetic.pose import Pose, at
from graings.capture.synthetic.scenes.plate import plate
from graings.capture.synthetic.shapes import Ball, Disc, RoundCone
from graings.capture.synthetic.textures import Lattice, Plain, Stripes, rgb
from graings.capture.synthetic.world import CameraPath, Part, World

REACH, HAND, TOP = 0.5, -0.35, 0.95


def _thrown(start: float) -> Callable[[float], Pose]:
    """A ball thrown from hand to hand and back, each time on a parabola."""

    def pose(time: float) -> Pose:
        phase = 2.0 * time + start
        flight = phase - math.floor(phase)
        forth = math.floor(phase) % 2 == 0
        across = REACH * (2.0 * flight - 1.0) * (1.0 if forth else -1.0)
        height = HAND + 4.0 * TOP * flight * (1.0 - flight)
        return at(across, 0.24 if forth else -0.24, height).turned("y", 0.7 * phase)

    return pose


def _hand(side: float) -> Callable[[float], Pose]:
    return lambda time: at(side * REACH, 0.24 * cosine(time), HAND - 0.24 + 0.03 * sine(6.0 * time))


def _stem(hand: Callable[[float], Pose]) -> Callable[[float], Pose]:
    """The handle below a hand."""
    return lambda time: hand(time).moved(0.0, 0.0, -0.02).turned("x", 0.5)


def build(seed: int) -> World:
    """The world of a seed."""
    arm = Plain(rgb("6f7680"))
    parts = [plate(-0.92, 0.85)]
    for side, color in ((-1.0, "c8452f"), (1.0, "2f6fae")):
        hand = _hand(side)
        parts += [
            Part(
                Disc(0.24, 0.03, 0.025),
                Stripes(rgb(color), rgb("f2e8d2"), (1.0, 0.0, 0.0), 0.13),
                pose=hand,
                moves=True,
                gloss=0.2,
            ),
            Part(
                RoundCone(0.28, 0.03, 0.06),
                arm,
                pose=_stem(hand),
                moves=True,
            ),
        ]
    colors = (("e0492f", "f5e3c0"), ("f0b42f", "7a3f2a"), ("3f8f5f", "e6f0d0"))
    for index, (low, high) in enumerate(colors):
        texture = Lattice(rgb(low), rgb(high), 0.3)
        parts.append(Part(Ball(0.2), texture, pose=_thrown(2.0 * index / 3.0), moves=True, gloss=0.3))
    return World(tuple(parts), CameraPath(elevation=(0.02, 0.12), target=(0.0, 0.0, -0.05)), cameras="rig")
