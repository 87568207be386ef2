"""RawCapture: the result of a reader, in the capture's own units of length and time.

Plain data between the readers and `graings.capture.normalize`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.capture import Kind, Split
from graings.capture.image_file import ImageFile
from graings.capture.lens import Lens

# Larger coordinates are errors of the file: differences of such numbers have too few digits left.
MAX_MAGNITUDE: Final = 1e15


@dataclass(frozen=True, slots=True, eq=False)
class RawFrame:
    """One image. `camera` is in the capture's unit of length and has the full size of the undistorted image."""

    image: ImageFile
    camera: Camera
    time: float | None  # None: the capture gives no times
    lens: Lens | None = None
    mask: ImageFile | None = None  # black where pixels are to be ignored


@dataclass(frozen=True, slots=True, eq=False)
class RawCapture:
    """All frames of a capture; points `positions` [M, 3] in the capture's unit with `colors` [M, 3] in [0, 1]."""

    kind: Kind
    splits: dict[Split, tuple[RawFrame, ...]]
    notes: tuple[str, ...] = ()
    positions: NDArray[np.float64] | None = None
    colors: NDArray[np.float32] | None = None

    def noted(self, *notes: str) -> RawCapture:
        """The same with further `notes`."""
        return replace(self, notes=(*self.notes, *notes))

    @staticmethod
    def with_points(
        kind: Kind,
        splits: dict[Split, tuple[RawFrame, ...]],
        notes: list[str],
        positions: NDArray[np.float64],
        colors: NDArray[np.float32],
    ) -> RawCapture:
        """As the constructor, without points that are not finite or beyond `MAX_MAGNITUDE`; a note counts them."""
        finite = np.asarray((np.abs(positions) <= MAX_MAGNITUDE).all(axis=1))  # False for NaN as well
        if not finite.all():
            notes = [
                *notes,
                f"{int((~finite).sum())} of {len(finite)} points are discarded: not finite or beyond {MAX_MAGNITUDE:g}",
            ]
        if not finite.any():
            return RawCapture(kind, splits, tuple(notes))
        return RawCapture(kind, splits, tuple(notes), positions[finite], colors[finite])
