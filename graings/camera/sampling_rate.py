"""SamplingRate: the resolution at which the training views sample the scene, in pixels per unit of length."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graings.camera.camera import Camera

REFERENCE_QUANTILE = 0.9  # of the rates of the training cameras: the reference
RATE_TOLERANCE = 1.05  # rates within this factor count as equal
MAX_DIRECT_RATIO = 1.5  # views at most this much coarser than the reference may be drawn without supersampling


@dataclass(frozen=True, slots=True)
class SamplingRate:
    """Sampling rates of the training cameras, in px per normalised unit; the scene lies within `extent` of the origin.

    The rate of a camera is sqrt(fx fy) over its distance from the origin, or over `extent` if it is nearer than that.
    `reference` is the 0.9 quantile over the training cameras: close views count, but a single close-up does not.
    `coarsest` is the smallest rate that is drawn without supersampling: that of the coarsest training camera, but at
    least `reference / MAX_DIRECT_RATIO`.
    """

    extent: float
    reference: float
    coarsest: float

    @staticmethod
    def of(cameras: Sequence[Camera], extent: float) -> SamplingRate:
        """The rates of `cameras`, at least one."""
        rates = [_rate(camera, extent) for camera in cameras]
        reference = float(np.quantile(rates, REFERENCE_QUANTILE))
        return SamplingRate(extent, reference, min(reference, max(min(rates), reference / MAX_DIRECT_RATIO)))

    def relative_rate(self, camera: Camera) -> float:
        """The rate of `camera` over the reference: above 1 if finer, below 1 if coarser, 1 within the tolerance."""
        rate = _rate(camera, self.extent)
        return rate / min(max(rate, self.reference / RATE_TOLERANCE), self.reference * RATE_TOLERANCE)

    def undersampling(self, camera: Camera) -> float:
        """How many times coarser `camera` is than `coarsest`; at most 1 if it needs no supersampling."""
        return self.coarsest / RATE_TOLERANCE / _rate(camera, self.extent)


def _rate(camera: Camera, extent: float) -> float:
    distance = max(float(np.linalg.norm(camera.center)), extent)
    return math.sqrt(camera.fx) * math.sqrt(camera.fy) / distance
