"""Silhouette: what masks tell of a picture and its colours do not.

Something of the background's colour looks like a hole: the photometric loss (Eq. 15) is content with either, and the
thing's other sides pay for it. Where a mask says that such a pixel is opaque, the opacity it lacks is a loss of its
own, which the paper does not have. Knows nothing of models or schedules.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from graings.capture.capture import Capture, Frame
from graings.capture.images import ImageStore
from graings.config import TrainConfig

# What differs from the background by less than this in every channel is taken to have its colour.
CONTRAST: Final = 8 / 255

# A mask speaks for a pixel above this coverage.
OPAQUE: Final = 0.5

# The share of the opaque pixels that has the background's colour: below the first the term has nothing to say, above
# the second the masks show what nobody sees, such as a white floor on white, and to build it would be a waste.
LEAST_HIDDEN: Final = 0.01
MOST_HIDDEN: Final = 0.5

# Views that are looked at to decide.
VIEWS: Final = 60


class Silhouette:
    """The loss of missing opacity. `share` is that of the opaque pixels which have the background's colour."""

    def __init__(self, images: ImageStore, background: Sequence[float], weight: float, share: float) -> None:
        self.share = share
        self._images = images
        self._background = torch.tensor(background, dtype=torch.float32)
        self._weight = weight

    @classmethod
    def of(cls, capture: Capture, images: ImageStore, config: TrainConfig) -> Silhouette | None:
        """That of a capture; None where its masks have nothing to add, or too much."""
        if config.loss.silhouette == 0 or not capture.has_alpha:
            return None
        background = config.capture.background_rgb()
        some = capture.train[:: -(-len(capture.train) // VIEWS)]
        share = hidden_share(some, images, background)
        needed = LEAST_HIDDEN <= share <= MOST_HIDDEN
        return cls(images, background, config.loss.silhouette, share) if needed else None

    def loss(self, opacity: Float[Tensor, "height width"], frame: Frame) -> Float[Tensor, ""]:
        """w mean over pixels of (alpha - |c - b|)+ (alpha - opacity)+, for what was drawn of `frame`.

        The first factor is how much of the mask's alpha the colour c of the picture leaves undecided: all of it where
        c is the background b, nothing where c differs by alpha in some channel.
        """
        alpha = self._images.alpha(frame)
        if alpha is None:
            return opacity.new_zeros(())
        mask = torch.from_numpy(alpha)
        contrast = (torch.from_numpy(self._images.rgb(frame)) - self._background).abs().amax(-1)
        return self._weight * ((mask - contrast).clamp_min(0.0) * (mask - opacity).clamp_min(0.0)).mean()


def hidden_share(frames: Sequence[Frame], images: ImageStore, background: Sequence[float]) -> float:
    """Share of the opaque pixels of `frames` that has the background's colour; 0 where none is opaque."""
    opaque = hidden = 0
    for frame in frames:
        both = opaque_and_hidden(frame, images, background)
        opaque, hidden = opaque + int(both[0].sum()), hidden + int(both[1].sum())
    return hidden / max(opaque, 1)


def opaque_and_hidden(
    frame: Frame, images: ImageStore, background: Sequence[float]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Where a frame is opaque, [H, W], and where it has the background's colour all the same.

    Without alpha it is opaque and nothing is hidden: what lies behind is in the picture, whatever its colour.
    """
    alpha = images.alpha(frame)
    if alpha is None:
        size = (frame.camera.height, frame.camera.width)
        return np.ones(size, np.bool_), np.zeros(size, np.bool_)
    opaque = alpha > OPAQUE
    apart = np.abs(images.rgb(frame) - np.asarray(background, np.float32)).max(axis=-1)
    return opaque, opaque & (apart <= CONTRAST)
