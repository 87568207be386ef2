"""Room: a furnished room in which only a toy train moves."""

from __future__ import annotations

from collections.abc import Callable

from graings.capture.synthetic.exact import cosine, sine
from graings.capture.synthetic.pose import Pose, at
from graings.capture.synthetic.scenes.crossing import walls
from graings.capture.synthetic.scenes.plate import resting
from graings.capture.synthetic.shapes import Ball, Box, Disc, Hoop, RoundCone
from graings.capture.synthetic.textures import Checker, Lattice, Marble, Plain, Stripes, rgb
from graings.capture.synthetic.world import CameraPath, Light, Part, World

TABLE = -0.55  # height of its top
TRACK = 0.45


def _car(lag: float) -> Callable[[float], Pose]:
    def pose(time: float) -> Pose:
        angle = 0.8 * time - lag
        return at(TRACK * cosine(angle), TRACK * sine(angle), TABLE + 0.09).turned("z", angle + 0.25)

    return pose


def build(seed: int) -> World:
    """The world of a seed."""
    oak = Marble((rgb("6a4526"), rgb("94663a"), rgb("b4844f")), 0.35, seed + 5)
    boards = Stripes(rgb("8a6038"), rgb("b58a58"), (1.0, 0.0, 0.0), 0.33)
    room = walls(
        seed,
        Checker(rgb("a9c0b4"), rgb("d3dccf"), (1, 2), 0.7),
        Stripes(rgb("c98f8a"), rgb("ecd9cc"), (1.0, 0.0, 0.0), 0.5),
        boards,
    )
    parts = [
        room,
        Part(Disc(0.85, 0.04), oak, pose=resting((0.0, 0.0, TABLE - 0.04)), gloss=0.1),
        Part(RoundCone(0.7, 0.12, 0.08), oak, pose=resting((0.0, 0.0, -1.33))),
        Part(
            Disc(1.2, 0.015, 0.01), Checker(rgb("7a2f3d"), rgb("d9b779"), (0, 1), 0.4), pose=resting((0.0, 0.0, -1.385))
        ),
        Part(Hoop(TRACK, 0.014), Plain(rgb("54585f")), pose=resting((0.0, 0.0, TABLE + 0.01)), gloss=0.3),
        Part(
            RoundCone(0.28, 0.1, 0.05),
            Stripes(rgb("2f6f8f"), rgb("e9e2cf"), (0.0, 0.0, 1.0), 0.14),
            pose=resting((0.0, 0.0, TABLE + 0.1)),
            gloss=0.3,
        ),
        Part(
            Box((0.3, 0.3, 0.42)),
            Checker(rgb("3f5f8c"), rgb("d9d0bc"), (1, 2), 0.3),
            pose=resting((-1.9, 1.5, -0.98), 0.05),
        ),
        Part(Ball(0.3), Lattice(rgb("d9812f"), rgb("f2e3c4"), 0.4), pose=resting((1.8, 1.45, -1.1))),
        Part(
            Disc(0.26, 0.55),
            Stripes(rgb("4f7f4a"), rgb("d8d8a8"), (0.0, 0.0, 1.0), 0.36),
            pose=resting((1.9, -1.5, -0.85)),
        ),
        Part(
            RoundCone(0.6, 0.28, 0.12),
            Marble((rgb("8f4a8a"), rgb("d9a0c0"), rgb("f4e4ea")), 0.4, seed + 6),
            pose=resting((-1.8, -1.45, -1.12)),
        ),
        Part(Box((0.12, 0.055, 0.06), 0.02), Plain(rgb("d8322a")), pose=_car(0.0), moves=True, gloss=0.3),
        Part(
            Disc(0.035, 0.06, 0.01),
            Plain(rgb("23262c")),
            pose=lambda time: _car(0.0)(time).moved(0.06, 0.0, 0.09),
            moves=True,
        ),
        Part(Box((0.1, 0.05, 0.05), 0.02), Plain(rgb("f0b52e")), pose=_car(0.095), moves=True, gloss=0.2),
        Part(Box((0.1, 0.05, 0.05), 0.02), Plain(rgb("3a8f57")), pose=_car(0.185), moves=True, gloss=0.2),
    ]
    path = CameraPath(distance=1.75, elevation=(0.04, 0.13), target=(0.0, 0.0, -0.6), focal=0.75, box=(2.2, 1.8, 1.1))
    light = Light(softness=0.12, sky=(0.4, 0.42, 0.46), ground=(0.5, 0.46, 0.42))
    return World(tuple(parts), path, light=lambda time: light, room=True)
