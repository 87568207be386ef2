"""Flag: a thin sheet waves in the wind."""

from __future__ import annotations

import numpy as np

from graings.capture.synthetic.deforming import Flag
from graings.capture.synthetic.exact import Array, sine
from graings.capture.synthetic.pose import at
from graings.capture.synthetic.scenes.plate import resting
from graings.capture.synthetic.shapes import Ball, Disc, RoundCone
from graings.capture.synthetic.textures import Plain, mixed, rgb
from graings.capture.synthetic.world import CameraPath, Part, World

WIDTH, HEIGHT = 1.5, 1.0


def _pattern(material: Array) -> Array:
    """Horizontal stripes with a sun in the middle and a border."""
    x, z = material[0], material[2]
    stripes = 0.5 + 0.5 * np.clip(4.0 * sine(z / HEIGHT * 2.5), -1.0, 1.0)
    colors = mixed(stripes, rgb("1f5f8b"), rgb("f4ead2"))
    dx, dz = x - 0.5 * WIDTH, z - 0.5 * HEIGHT
    across = np.sqrt(dx * dx + dz * dz)
    sun = np.clip((0.27 - across) * 50.0 + 0.5, 0.0, 1.0)
    colors = colors + (np.array(rgb("e2452f"))[:, None] - colors) * sun
    core = np.clip((0.12 - across) * 50.0 + 0.5, 0.0, 1.0)
    colors = colors + (np.array(rgb("f6c945"))[:, None] - colors) * core
    edge = np.minimum(np.minimum(x, WIDTH - x), np.minimum(z, HEIGHT - z))
    border = np.clip((0.05 - edge) * 50.0 + 0.5, 0.0, 1.0)
    return colors + (np.array(rgb("8a2436"))[:, None] - colors) * border


def build(seed: int) -> World:
    """The world of a seed."""
    sheet = Flag(WIDTH, HEIGHT, 0.012, 0.17, 1.3, 2.0, 0.12)
    pole = Plain(rgb("b9bfc6"))
    hung = at(-0.72, 0.0, -0.22)
    return World(
        (
            Part(Disc(0.34, 0.04), Plain(rgb("6b6f76")), pose=resting((-0.72, 0.0, -1.0))),
            Part(RoundCone(1.75, 0.035, 0.025), pole, pose=resting((-0.745, 0.0, -0.96)), gloss=0.4),
            Part(Ball(0.06), Plain(rgb("d9a93a")), pose=resting((-0.745, 0.0, 0.84)), gloss=0.5),
            Part(sheet, _pattern, pose=lambda time: hung, moves=True),
        ),
        CameraPath(distance=3.7, elevation=(0.01, 0.1), target=(0.0, 0.0, -0.08)),
    )
