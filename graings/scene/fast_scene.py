"""FastScene: a prepared scene whose motion is approximated in the views where that shows little, and exact in others.

A bound in pixels holds in the training views. A camera that comes nearer, or has more pixels, magnifies the same error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from graings.camera.camera import Camera, View
from graings.scene.motion_basis import MotionBasis
from graings.scene.motion_report import MotionBasisReport
from graings.scene.motion_signals import pixels_per_unit
from graings.scene.prepared import PreparedScene

# Errors for 99 % of the children and times: in px of the training views, in grey levels, and in px of any view.
PIXELS: Final = 0.2
LEVELS: Final = 1.0
MOST_PIXELS: Final = 0.5

# Moving children whose magnification is compared for each view: 256 take less than a tenth of a millisecond.
SAMPLES: Final = 256


@dataclass(frozen=True, slots=True, eq=False)
class FastScene:
    """Make it with `of`. `report` says how far `approximate` is from `exact` in the training views."""

    exact: PreparedScene
    approximate: PreparedScene
    report: MotionBasisReport
    _positions: NDArray[np.float64]  # [sample, 3] of moving children, mean over time, normalised units
    _rates: NDArray[np.float64]  # [sample] px per unit of length in the training view that shows each largest

    @staticmethod
    def of(exact: PreparedScene, views: Sequence[View]) -> FastScene:
        """Approximate `exact` within PIXELS and LEVELS of 255 in the training `views`; takes seconds."""
        basis = MotionBasis.of(exact, views, pixels=PIXELS, levels=LEVELS)
        moving = basis.geometry.rows
        some = moving[torch.linspace(0, max(len(moving) - 1, 0), min(SAMPLES, len(moving))).long()]
        return FastScene(
            exact,
            basis.prepared(exact),
            basis.report,
            basis.means[some].double().numpy(),
            basis.pixel_rates[some].double().numpy(),
        )

    def error(self, camera: Camera) -> float:
        """Estimate in px of what the approximation errs in a view of `camera`, for 99 % of what moves in it.

        The error in the training views times the magnification, both for 99 % of the moving children. Infinite where
        the view shows no sample, unless all moving children are samples.
        """
        rates = pixels_per_unit(camera, self._positions)
        seen = rates > 0
        if not seen.any():
            return 0.0 if len(self._rates) == self.report.geometry.children else float("inf")
        magnified = rates[seen] / self._rates[seen]
        rank = round(0.99 * (len(magnified) - 1))  # np.quantile takes twenty times as long
        return self.report.geometry.error.p99 * float(np.partition(magnified, rank)[rank])

    def seen_by(self, camera: Camera) -> PreparedScene:
        """The scene to draw for `camera`: exact where the approximation would err by more than MOST_PIXELS."""
        return self.exact if self.error(camera) > MOST_PIXELS else self.approximate

    def line(self, camera: Camera) -> str:
        """How far a view of `camera` is from the exact one, in one line of text."""
        if self.seen_by(camera) is self.approximate:
            return self.report.line
        return f"exact, because this view would magnify errors of motion beyond {MOST_PIXELS:g} px"
