"""Background of opaque images: the colour along the image borders, if nearly all border pixels have the same one.

Pixels of this colour then count as background, as transparent pixels do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graings.capture.capture import Capture, Frame
from graings.capture.images import Image, ImageStore
from graings.config import CaptureConfig

# Colours that differ by no more than this in every channel count as equal: compression adds noise of a few levels.
COLOR_TOLERANCE: Final = 8 / 255

# Least fraction of border pixels that must have one colour; objects may reach over the border in places.
MIN_BORDER_FRACTION: Final = 0.9

# Number of images that are examined, evenly spread over the training images.
SAMPLED_IMAGES: Final = 8

RGB = tuple[float, float, float]


def with_background(config: CaptureConfig, capture: Capture) -> CaptureConfig:
    """`config` with `background` "auto" replaced by the colour of the image borders of `capture`.

    White where the borders are transparent or have more than one colour. The mere presence of an alpha channel does
    not decide, because many files have one that is opaque everywhere. Raises `CaptureError` where an image cannot be
    read.
    """
    if config.background != "auto":
        return config
    white = config.background_rgb()
    border = border_color(capture.train, ImageStore(white, config.cache_mb))
    return config.model_copy(update={"background": "white" if border in (None, white) else border})


def border_color(frames: Sequence[Frame], images: ImageStore) -> RGB | None:
    """The colour of nearly all border pixels of `frames`, in steps of 1/255; None where they differ.

    Transparent pixels count with the background colour of `images`, masked ones not at all.
    """
    sampled = np.unique(np.linspace(0, len(frames) - 1, SAMPLED_IMAGES).round().astype(int))
    pixels = np.concatenate([_border_pixels(frames[index], images) for index in sampled])
    if not len(pixels):
        return None
    color = np.rint(np.median(pixels, axis=0).astype(np.float64) * 255) / 255
    if (np.abs(pixels - color).max(axis=-1) <= COLOR_TOLERANCE).mean() < MIN_BORDER_FRACTION:
        return None
    red, green, blue = color.tolist()
    return red, green, blue


def _border_pixels(frame: Frame, images: ImageStore) -> Image:
    """The outermost pixels [N, 3] of an image, without masked ones."""
    valid, border = images.valid(frame), _border(images.rgb(frame))
    return border if valid is None else border[_border(valid)]


def _border(values: NDArray[Any]) -> NDArray[Any]:
    """The outermost values [N, ...] of an array [H, W, ...]."""
    return np.concatenate([values[0], values[-1], values[1:-1, 0], values[1:-1, -1]])
