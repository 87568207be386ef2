"""Crossing: a toy rocket crosses a textured room."""

from __future__ import annotations

from collections.abc import Callable

from graings.capture.synthetic.exact import sine
from graings.capture.synthetic.pose import Pose, at
from graings.capture.synthetic.scenes.plate import resting
from graings.capture.synthetic.shapes import Ball, Box, Disc, Hoop, Room, RoundCone
from graings.capture.synthetic.textures import ByNormal, Checker, Lattice, Marble, Plain, Stripes, Texture, rgb
from graings.capture.synthetic.world import CameraPath, Light, Part, World

HALF = (2.6, 2.2, 1.4)


def walls(seed: int, sides: Texture, ends: Texture, floor: Texture) -> Part:
    """The room itself."""
    ceiling = Plain(rgb("d9d4c8"))
    return Part(Room(HALF), ByNormal(HALF, floor, ceiling, sides, ends))


def _flight(time: float) -> Pose:
    x = -1.15 + 2.3 * time
    rise = -0.1 + 0.32 * sine(0.9 * time)
    near = 0.3 * sine(0.5 * time)
    # The rocket's z axis points along the flight.
    return at(x, near, rise).turned("x", 1.3 * time).turned("y", 0.25 - 0.06 * sine(0.9 * time + 0.25))


def _fin(turns: float) -> Callable[[float], Pose]:
    return lambda time: _flight(time).turned("z", turns).moved(0.17, 0.0, -0.02).turned("y", 0.06)


def build(seed: int) -> World:
    """The world of a seed."""
    bricks = Checker(rgb("c47a55"), rgb("dca27c"), (1, 2), 0.5)
    paper = Checker(rgb("8fb0c4"), rgb("cfdcd8"), (0, 2), 0.62)
    wood = Marble((rgb("7a4f2c"), rgb("a87445"), rgb("c9955c")), 0.5, seed + 3)
    body = Stripes(rgb("f2f2ee"), rgb("d8382c"), (0.0, 0.0, 1.0), 0.3, 0.1)
    parts = [
        walls(seed, bricks, paper, wood),
        Part(RoundCone(0.5, 0.17, 0.075), body, pose=_flight, moves=True, gloss=0.25),
        Part(
            Hoop(0.165, 0.03), Plain(rgb("2d3c59")), pose=lambda time: _flight(time).moved(0.0, 0.0, 0.17), moves=True
        ),
        Part(Ball(0.11), Plain(rgb("f5a623")), pose=lambda time: _flight(time).moved(0.0, 0.0, -0.14), moves=True),
    ]
    for index in range(3):
        fin = Box((0.14, 0.018, 0.12), 0.015)
        parts.append(Part(fin, Plain(rgb("2d3c59")), pose=_fin(index / 3), moves=True))
    parts += [
        Part(
            Box((0.3, 0.3, 0.3)),
            Checker(rgb("3d7a6a"), rgb("e8dfc8"), (0, 2), 0.3),
            pose=resting((-1.5, 1.3, -1.1), 0.06),
        ),
        Part(
            Disc(0.28, 0.42),
            Stripes(rgb("d9a441"), rgb("7a3f6a"), (0.0, 0.0, 1.0), 0.28),
            pose=resting((1.4, 1.4, -0.98)),
        ),
        Part(Ball(0.32), Lattice(rgb("c94f3d"), rgb("f0dcc0"), 0.4), pose=resting((0.2, 1.2, -1.08))),
    ]
    path = CameraPath(
        distance=2.6,
        azimuth=(0.62, 0.88),
        elevation=(0.0, 0.08),
        target=(0.0, 0.5, -0.1),
        focal=0.72,
        box=(2.3, 1.95, 1.15),
    )
    light = Light(
        direction=(0.3841106397986879, -0.5121475197315839, 0.7682212795973759), softness=0.1, ground=(0.46, 0.43, 0.4)
    )
    return World(tuple(parts), path, light=lambda time: light, room=True)
