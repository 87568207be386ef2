"""Resolution: how much smaller than the photographs the pictures are that a step of training compares.

Small ones come first: they say where things are and how they move, at a fraction of the cost. Knows nothing of images,
models or losses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from graings.camera.camera import Camera
from graings.config import TrainConfig

MIN_SIDE: Final = 200  # px of the longest side, which is never halved below


def downscale_factor(config: TrainConfig, cameras: Sequence[Camera], iteration: int) -> int:
    """How many times smaller along each side than those of `cameras` the pictures of `iteration` (from 1) are.

    A power of two, as large as `MIN_SIDE` allows at first; it halves at even intervals and
    is 1 after `low_resolution_until`.
    """
    until = config.scaled(config.low_resolution_until)
    if max(1, iteration) > until:
        return 1
    longest = max(max(camera.width, camera.height) for camera in cameras)
    halvings = max(0, (longest // MIN_SIDE).bit_length() - 1)
    return 1 << halvings - halvings * max(0, iteration - 1) // until


def downscaled(camera: Camera, times: int) -> Camera:
    """The view of `camera` on a grid so many times coarser along each side."""
    return camera if times == 1 else camera.resized(math.ceil(camera.width / times), math.ceil(camera.height / times))
