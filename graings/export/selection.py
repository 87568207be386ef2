"""Selection: which splats an export keeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from graings import constants
from graings.camera.units import Units
from graings.export.harmonics_fit import HarmonicsFit

# Less than this in every view is not seen: it changes one pixel by less than a grey level.
LEAST_CONTRIBUTION: Final = constants.ALPHA_MIN


@dataclass(frozen=True, slots=True)
class Selection:
    """Bounds of the centres in the capture's units, and whether splats that no training view shows are dropped.

    `box` is x, y, z of the lower corner and of the upper one, `sphere` x, y, z and radius. Raises `ValueError` for an
    empty box or sphere.
    """

    box: tuple[float, ...] | None = None
    sphere: tuple[float, ...] | None = None
    seen: bool = False

    def __post_init__(self) -> None:
        for name, values in (("box", self.box), ("sphere", self.sphere)):
            if values is not None and not np.isfinite(values).all():
                raise ValueError(f"{name} must be finite numbers, got {values}")
        if (self.box is not None and len(self.box) != 6) or (self.sphere is not None and len(self.sphere) != 4):
            raise ValueError("box must be six numbers, x y z of two corners, and sphere four, x y z and a radius")
        if self.box is not None and any(low >= high for low, high in zip(self.box[:3], self.box[3:], strict=True)):
            raise ValueError(f"box must be x y z of its lower corner, then of its upper one, got {self.box}")
        if self.sphere is not None and self.sphere[3] <= 0:
            raise ValueError(f"sphere must be x y z and a radius above 0, got {self.sphere}")

    def kept(self, fit: HarmonicsFit, units: Units) -> Bool[Tensor, " gaussian"]:
        """Which splats of `fit` are kept."""
        points = torch.from_numpy(units.points_back(fit.splats.means.double().numpy()))
        kept = torch.ones(len(points), dtype=torch.bool)
        if self.box is not None:
            low, high = points.new_tensor(self.box[:3]), points.new_tensor(self.box[3:])
            kept &= ((points >= low) & (points <= high)).all(1)
        if self.sphere is not None:
            kept &= (points - points.new_tensor(self.sphere[:3])).norm(dim=1) <= self.sphere[3]
        if self.seen:
            kept &= fit.contributions >= LEAST_CONTRIBUTION
        return kept
