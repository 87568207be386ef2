"""Dimmer: the exposure rises and falls and nothing moves."""

from __future__ import annotations

from graings.capture.synthetic.exact import cosine
from graings.capture.synthetic.scenes.plate import plate, resting
from graings.capture.synthetic.shapes import Ball, Box, Hoop, RoundCone
from graings.capture.synthetic.textures import Lattice, Marble, Plain, Stripes, rgb
from graings.capture.synthetic.world import CameraPath, Part, World


def _exposure(time: float) -> float:
    return 0.62 - 0.4 * cosine(1.5 * time)


def build(seed: int) -> World:
    """The world of a seed."""
    slate = Marble((rgb("6f7d86"), rgb("a9b4b8"), rgb("d6dad6")), 0.45, seed + 9)
    parts = [plate(-0.6, 1.05, slate)]
    for level, (half, color) in enumerate(((0.34, "b5483a"), (0.26, "d9a23f"), (0.18, "3f7f8f"))):
        z = -0.6 + sum((0.34, 0.26, 0.18)[:level]) + 0.5 * half
        stripes = Stripes(rgb(color), rgb("f1e8d6"), (0.0, 0.0, 1.0), 0.13)
        parts.append(
            Part(Box((half, half, 0.5 * half), 0.03), stripes, pose=resting((-0.2, 0.1, z), 0.05 + 0.07 * level))
        )
    parts += [
        Part(Ball(0.13), Plain(rgb("f0e3c0")), pose=resting((-0.2, 0.1, 0.31)), gloss=0.4),
        Part(Ball(0.25), Lattice(rgb("4a5fa0"), rgb("dfe3ee"), 0.33), pose=resting((0.55, -0.3, -0.35)), gloss=0.3),
        Part(
            Hoop(0.24, 0.07),
            Stripes(rgb("5f8f4a"), rgb("e6e3b8"), (1.0, 0.0, 0.0), 0.13),
            pose=resting((-0.3, -0.62, -0.53)),
            gloss=0.2,
        ),
        Part(RoundCone(0.42, 0.14, 0.05), Plain(rgb("9a5f9f")), pose=resting((0.52, 0.5, -0.46)), gloss=0.2),
    ]
    return World(tuple(parts), CameraPath(target=(0.0, 0.0, -0.2), distance=3.6), exposure=_exposure)
