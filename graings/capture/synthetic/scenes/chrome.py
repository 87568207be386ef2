"""Chrome: a mirror ball reflects the bodies that orbit it."""

from __future__ import annotations

from collections.abc import Callable

from graings.capture.synthetic.exact import cosine, sine
from graings.capture.synthetic.pose import Pose, at
from graings.capture.synthetic.scenes.plate import plate, resting
from graings.capture.synthetic.shapes import Ball
from graings.capture.synthetic.textures import Checker, Lattice, Plain, Stripes, rgb
from graings.capture.synthetic.world import CameraPath, Part, World


def _orbit(start: float, reach: float, height: float, turns: float) -> Callable[[float], Pose]:
    def pose(time: float) -> Pose:
        angle = start + turns * time
        return at(reach * cosine(angle), reach * sine(angle), height).turned("z", 2.0 * angle)

    return pose


def build(seed: int) -> World:
    """The world of a seed."""
    floor = Checker(rgb("3a3f4a"), rgb("e9e4da"), (0, 1), 0.5)
    return World(
        (
            plate(-0.62, 1.2, floor),
            Part(
                Ball(0.56),
                Plain((0.97, 0.97, 0.98)),
                pose=resting((0.0, 0.0, -0.06)),
                mirror=0.95,
                gloss=1.0,
                sharpness=8,
            ),
            Part(
                Ball(0.17),
                Stripes(rgb("e0452f"), rgb("f6e7c8"), (0.0, 0.0, 1.0), 0.16),
                pose=_orbit(0.0, 0.88, -0.45, 0.8),
                moves=True,
                gloss=0.4,
            ),
            Part(
                Ball(0.13), Plain(rgb("f2b632")), pose=_orbit(0.36, 0.9, -0.49, 0.8), moves=True, gloss=0.5, sharpness=6
            ),
            Part(
                Ball(0.15),
                Lattice(rgb("2f6fb3"), rgb("d5e8f2"), 0.25),
                pose=_orbit(0.66, 0.86, -0.47, 0.8),
                moves=True,
                gloss=0.4,
            ),
        ),
        CameraPath(elevation=(0.03, 0.13), target=(0.0, 0.0, -0.18)),
    )
