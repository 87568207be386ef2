"""The resolution schedule: training begins with downscaled images.

They are enough to find positions and motion, at a fraction of the cost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from graings.camera.camera import Camera
from graings.config import TrainConfig

MIN_SIDE: Final = 200  # px; the longest side is not reduced below


def downscale_factor(config: TrainConfig, cameras: Sequence[Camera], iteration: int) -> int:
    """By which factor the images of `cameras` are downscaled along each side at `iteration` (from 1).

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
    """`camera` with an image `times` smaller along each side."""
    return camera if times == 1 else camera.resized(math.ceil(camera.width / times), math.ceil(camera.height / times))
