"""Recording: what a reader found, in the capture's own lengths and times.

Plain data between the readers and `graings.capture.normalize`. Knows nothing of either.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.capture import Split
from graings.capture.image_file import ImageFile
from graings.capture.lens import Lens

# Larger lengths or times leave no room to compute with them: they are slips of the file.
MAX_DISTANCE: Final = 1e15


@dataclass(frozen=True, slots=True, eq=False)
class RawFrame:
    """One image as it was taken. `camera` has the capture's length unit and the undistorted picture's full size."""

    image: ImageFile
    camera: Camera
    time: float | None  # None: the capture says nothing of time
    lens: Lens | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RawCapture:
    """All shots of a capture; `positions` [M, 3] in the capture's unit with `colors` [M, 3] in [0, 1]."""

    kind: Literal["transforms", "colmap"]
    splits: dict[Split, tuple[RawFrame, ...]]
    notes: tuple[str, ...] = ()
    positions: NDArray[np.float64] | None = None
    colors: NDArray[np.float32] | None = None

    @staticmethod
    def with_points(
        kind: Literal["transforms", "colmap"],
        splits: dict[Split, tuple[RawFrame, ...]],
        notes: list[str],
        positions: NDArray[np.float64],
        colors: NDArray[np.float32],
    ) -> RawCapture:
        """As the constructor, without points that cannot be computed with, of which a note then speaks."""
        finite = np.asarray((np.abs(positions) <= MAX_DISTANCE).all(axis=1))  # False for NaN as well
        if not finite.all():
            notes = [
                *notes,
                f"{int((~finite).sum())} of {len(finite)} points are not finite or absurdly far and left out",
            ]
        if not finite.any():
            return RawCapture(kind, splits, tuple(notes))
        return RawCapture(kind, splits, tuple(notes), positions[finite], colors[finite])
