"""Still: a group of bodies at one instant."""

from __future__ import annotations

from graings.capture.synthetic.pose import at
from graings.capture.synthetic.scenes.plate import plate, resting
from graings.capture.synthetic.shapes import Ball, Box, Disc, Hoop, RoundCone
from graings.capture.synthetic.textures import Checker, Lattice, Marble, Plain, Stripes, rgb
from graings.capture.synthetic.world import CameraPath, Part, World


def build(seed: int) -> World:
    """The world of a seed."""
    cloth = Checker(rgb("8fa3a8"), rgb("e4e6df"), (0, 1), 0.4)
    lying = at(0.12, -0.62, -0.52).turned("y", 0.25).turned("x", 0.06)
    return World(
        (
            plate(-0.6, 1.1, cloth),
            Part(
                RoundCone(0.62, 0.27, 0.1),
                Marble((rgb("23507a"), rgb("5f9fc4"), rgb("f1ead8")), 0.35, seed + 4),
                pose=resting((-0.12, 0.28, -0.33)),
                gloss=0.4,
            ),
            Part(Ball(0.24), Lattice(rgb("d95f30"), rgb("f3c65c"), 0.3), pose=resting((0.5, 0.12, -0.36)), gloss=0.3),
            Part(Ball(0.17), Plain(rgb("7fa83d")), pose=resting((0.22, -0.28, -0.43)), gloss=0.4),
            Part(
                Box((0.2, 0.2, 0.2), 0.03),
                Stripes(rgb("a83248"), rgb("f0ddd0"), (0.0, 0.0, 1.0), 0.13),
                pose=resting((-0.52, -0.3, -0.4), 0.08),
            ),
            Part(Hoop(0.2, 0.05), Plain(rgb("c9a23f")), pose=resting((-0.52, -0.3, -0.15)), gloss=0.6, sharpness=6),
            Part(
                RoundCone(0.5, 0.08, 0.05),
                Stripes(rgb("4a3a6a"), rgb("d9cfe6"), (0.0, 0.0, 1.0), 0.12),
                pose=lambda time: lying,
                gloss=0.2,
            ),
            Part(
                Disc(0.15, 0.17),
                Checker(rgb("2f6f5a"), rgb("e9dfbf"), (0, 2), 0.2),
                pose=resting((-0.72, 0.42, -0.43)),
                gloss=0.1,
            ),
        ),
        CameraPath(elevation=(0.03, 0.16), target=(0.0, 0.0, -0.25), distance=3.6),
        cameras="still",
    )
