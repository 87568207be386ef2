"""SamplingRate: how finely the training views sample the content, in pixels per unit of length."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graings.camera.camera import Camera

REFERENCE_QUANTILE = 0.9  # of the cameras of training do not look finer than the reference
RATE_TOLERANCE = 1.05  # so many times finer or coarser makes no difference
MAX_DIRECT_RATIO = 1.5  # times coarser than the reference: down to there what training drew is served alike


@dataclass(frozen=True, slots=True)
class SamplingRate:
    """How finely the cameras of training look at the content, which lies within `extent` of the origin.

    `reference`, in px per normalised unit at the origin, is what nine of ten of them do not exceed: the details of the
    near ones count, and a single close-up does not. `coarsest` is what is still drawn at once, as training draws all:
    the coarsest of them, but not much below the reference. A camera's own is sqrt(fx fy) over its distance, or over the
    extent where it is nearer than that and so amid the content.
    """

    extent: float
    reference: float
    coarsest: float

    @staticmethod
    def of(cameras: Sequence[Camera], extent: float) -> SamplingRate:
        """That of at least one camera."""
        every = [_sampling(camera, extent) for camera in cameras]
        reference = float(np.quantile(every, REFERENCE_QUANTILE))
        return SamplingRate(extent, reference, min(reference, max(min(every), reference / MAX_DIRECT_RATIO)))

    def relative_rate(self, camera: Camera) -> float:
        """How many times finer than the reference `camera` looks; below 1 if coarser, 1 if about alike."""
        own = _sampling(camera, self.extent)
        return own / min(max(own, self.reference / RATE_TOLERANCE), self.reference * RATE_TOLERANCE)

    def undersampling(self, camera: Camera) -> float:
        """How many times coarser `camera` looks than what is drawn at once; 1 and less if it is not coarser."""
        return self.coarsest / RATE_TOLERANCE / _sampling(camera, self.extent)


def _sampling(camera: Camera, extent: float) -> float:
    distance = max(float(np.linalg.norm(camera.center)), extent)
    return math.sqrt(camera.fx) * math.sqrt(camera.fy) / distance
