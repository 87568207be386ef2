"""Globe: a finely textured sphere turns about a tilted axis."""

from __future__ import annotations

from graings.capture.synthetic.pose import Pose, at
from graings.capture.synthetic.scenes.plate import plate, resting
from graings.capture.synthetic.shapes import Ball, Disc, Hoop, RoundCone
from graings.capture.synthetic.textures import Globe, Marble, Plain, rgb
from graings.capture.synthetic.world import CameraPath, Part, World

TILT = 0.065


def _tilted(time: float) -> Pose:
    return at(0.0, 0.0, 0.16).turned("x", TILT)


def _turning(time: float) -> Pose:
    return _tilted(time).turned("z", 0.8 * time)


def build(seed: int) -> World:
    """The world of a seed."""
    brass = Plain(rgb("c9a14a"))
    wood = Marble((rgb("5f3b22"), rgb("8a5a33"), rgb("a8763f")), 0.3, seed + 1)
    return World(
        (
            plate(-0.92, 0.8, wood),
            Part(Disc(0.36, 0.05), brass, pose=resting((0.0, 0.0, -0.87)), gloss=0.4),
            Part(RoundCone(0.16, 0.09, 0.05), brass, pose=resting((0.0, 0.0, -0.84)), gloss=0.4),
            Part(Hoop(0.84, 0.028), brass, pose=lambda time: _tilted(time).turned("y", 0.25), gloss=0.4),
            Part(Ball(0.76), Globe(seed + 7), pose=_turning, moves=True, gloss=0.12),
            Part(Ball(0.06), brass, pose=lambda time: _tilted(time).moved(0.0, 0.0, 0.84), gloss=0.4),
        ),
        CameraPath(target=(0.0, 0.0, 0.02)),
    )
