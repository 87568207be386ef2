"""Sundial: nothing moves but the light, and with it shadows and shading."""

from __future__ import annotations

import math

from graings.capture.synthetic.exact import cosine, sine
from graings.capture.synthetic.pose import at
from graings.capture.synthetic.scenes.plate import plate, resting
from graings.capture.synthetic.shapes import Ball, Box, Disc, Hoop, RoundCone
from graings.capture.synthetic.textures import Checker, Marble, Plain, rgb
from graings.capture.synthetic.world import CameraPath, Light, Part, World


def _light(time: float) -> Light:
    elevation = 0.085 + 0.055 * sine(0.5 * time)
    azimuth = -0.22 + 0.44 * time
    reach = cosine(elevation)
    x, y, z = reach * cosine(azimuth), reach * sine(azimuth), sine(elevation)
    length = math.sqrt(x * x + y * y + z * z)
    warm = 1.0 - sine(0.5 * time)
    color = (1.12, 1.0 - 0.18 * warm, 0.86 - 0.34 * warm)
    return Light((x / length, y / length, z / length), color, (0.26, 0.31, 0.42), (0.17, 0.15, 0.14), 0.06)


def build(seed: int) -> World:
    """The world of a seed."""
    stone = Marble((rgb("cfc6b4"), rgb("e9e2d2"), rgb("f4efe4")), 0.5, seed + 2, 0.8)
    gnomon = at(-0.1, 0.0, -0.52).turned("y", 0.12)
    return World(
        (
            plate(-0.55, 1.2, Checker(rgb("d8cdb8"), rgb("efe8da"), (0, 1), 0.6)),
            Part(Hoop(0.92, 0.035), Plain(rgb("8a6a3a")), pose=resting((0.0, 0.0, -0.55)), gloss=0.2),
            Part(RoundCone(0.95, 0.06, 0.02), Plain(rgb("b8863b")), pose=lambda time: gnomon, gloss=0.3),
            Part(Box((0.14, 0.14, 0.3)), stone, pose=resting((0.42, 0.42, -0.25), 0.07)),
            Part(Ball(0.19), Plain(rgb("3d7f8c")), pose=resting((-0.45, 0.5, -0.36)), gloss=0.25),
            Part(Disc(0.13, 0.2), Plain(rgb("c2503a")), pose=resting((0.35, -0.5, -0.35)), gloss=0.1),
            Part(RoundCone(0.34, 0.17, 0.03), Plain(rgb("6f9a4a")), pose=resting((-0.5, -0.42, -0.38))),
        ),
        CameraPath(elevation=(0.06, 0.18), target=(0.0, 0.0, -0.36), distance=3.8),
        light=_light,
    )
