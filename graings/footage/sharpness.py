"""Sharpness of a frame, and which frames of a clip are blurred by motion."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

# Width in px at which frames are compared: finer detail is noise in most video.
WIDTH: Final = 480

# A frame is blurred where its sharpness is below this share of the median of its neighbours on either side.
MIN_SHARE: Final = 0.55
NEIGHBOURS: Final = 4


def sharpness(luma: NDArray[np.uint8]) -> float:
    """Mean absolute Laplacian of `luma` [H, W] in levels of 255; 0 for an image under 3 px."""
    values = luma.astype(np.float32)
    if min(values.shape) < 3:
        return 0.0
    inner = values[1:-1, 1:-1]
    laplacian = 4 * inner - values[:-2, 1:-1] - values[2:, 1:-1] - values[1:-1, :-2] - values[1:-1, 2:]
    return float(np.abs(laplacian).mean())


def blurred(values: Sequence[float]) -> list[bool]:
    """For each sharpness in order of time, whether its frame is blurred beside its neighbours."""
    found = []
    for index, value in enumerate(values):
        around = [*values[max(index - NEIGHBOURS, 0) : index], *values[index + 1 : index + 1 + NEIGHBOURS]]
        found.append(bool(around) and value < MIN_SHARE * statistics.median(around))
    return found
