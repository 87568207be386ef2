"""Backdrop: the one colour that surrounds what opaque pictures show, if there is one.

It is the background then: what has its colour is drawn with nothing. Knows nothing of training.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from graings.capture.capture import Capture, Frame
from graings.capture.images import Image, ImageStore
from graings.config import CaptureConfig

# Colours that differ by no more than this in any channel are one: compression leaves a few levels of noise.
COLOR_TOLERANCE: Final = 8 / 255

# This share of all edges must be of one colour; what is shown may reach over an edge here and there.
LEAST_SURROUNDED: Final = 0.9

# So many pictures are looked at, spread over the clip.
PICTURES: Final = 8

RGB = tuple[float, float, float]


def with_background(config: CaptureConfig, capture: Capture) -> CaptureConfig:
    """`config` with a colour for `background` where that is left to the pictures of `capture` (auto).

    White where they are transparent around what they show, or have no one colour there. An alpha channel alone says
    nothing: many files have one that is opaque everywhere. Raises `CaptureError` where a picture cannot be read.
    """
    if config.background != "auto":
        return config
    white = config.background_rgb()
    found = border_color(capture.train, ImageStore(white, config.cache_mb))
    return config.model_copy(update={"background": "white" if found in (None, white) else found})


def border_color(frames: Sequence[Frame], images: ImageStore) -> RGB | None:
    """The colour of nearly all edges of `frames`, in steps of 1/255; None where they are of more than one.

    What is transparent has the background of `images`.
    """
    chosen = np.unique(np.linspace(0, len(frames) - 1, PICTURES).round().astype(int))
    edges = np.concatenate([_edge(images.rgb(frames[index])) for index in chosen])
    colour = np.rint(np.median(edges, axis=0).astype(np.float64) * 255) / 255
    if (np.abs(edges - colour).max(axis=-1) <= COLOR_TOLERANCE).mean() < LEAST_SURROUNDED:
        return None
    red, green, blue = colour.tolist()
    return red, green, blue


def _edge(image: Image) -> Image:
    """The outermost pixels [N, 3] of an image [H, W, 3]."""
    return np.concatenate([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])
