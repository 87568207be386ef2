"""Ring: a torus whose hole closes until it is a sphere."""

from __future__ import annotations

from graings.capture.synthetic.deforming import ClosingTorus, closing_radius, closing_tube
from graings.capture.synthetic.exact import sine
from graings.capture.synthetic.pose import Pose, at
from graings.capture.synthetic.textures import Marble, rgb
from graings.capture.synthetic.world import CameraPath, Part, World


def _pose(time: float) -> Pose:
    return at(0.0, 0.0, 0.0).turned("x", 0.03 * sine(time)).turned("y", 0.05 * sine(0.5 * time) - 0.02)


def build(seed: int) -> World:
    """The world of a seed."""
    glaze = Marble((rgb("1f6f78"), rgb("3fb0a4"), rgb("f3e9c6"), rgb("e8743b"), rgb("b8323a")), 1.1, seed + 11, 1.6)
    shape = ClosingTorus(closing_radius, closing_tube)
    return World(
        (Part(shape, glaze, pose=_pose, moves=True, gloss=0.3),), CameraPath(distance=3.7, elevation=(0.09, 0.22))
    )
