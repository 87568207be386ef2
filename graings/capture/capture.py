"""Capture: images with known cameras and times. Frame: one of these images.

Plain data in normalised units. Files are read by `graings.capture.readers`, pixels decoded by `graings.capture.images`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera, View
from graings.camera.units import Units
from graings.capture.lens import Lens

Kind = Literal["transforms", "colmap", "nerfies", "llff"]
Split = Literal["train", "val", "test", "between"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")
# Beside the usual splits some captures hold images at times between those of training.
ALL_SPLITS: tuple[Split, ...] = (*SPLITS, "between")


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image. `camera` is that of the image as `ImageStore` returns it: undistorted and downscaled."""

    name: str  # file name relative to the capture, unique within a split
    camera: Camera
    time: float  # normalised to [0, 1]
    image_path: Path
    source_size: tuple[int, int]  # width, height of the file in pixels
    lens: Lens | None = None  # how to undistort the file; None: it is a pinhole image already
    orientation: int = 1  # the EXIF code by which the file's pixels are turned; 1: as stored
    mask_path: Path | None = None  # an image that is black where pixels are to be ignored

    def view(self) -> View:
        """The frame without its image."""
        return View(self.name, self.camera, self.time)


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Structure-from-motion points: positions [M, 3] in normalised units, colours [M, 3] in [0, 1]."""

    positions: NDArray[np.float64]
    colors: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Images with known cameras and times, in three splits (only `train` must hold frames)."""

    root: Path
    kind: Kind
    train: tuple[Frame, ...]
    val: tuple[Frame, ...]
    test: tuple[Frame, ...]
    units: Units
    has_alpha: bool  # some image carries an alpha channel
    points: PointCloud | None = None
    between: tuple[Frame, ...] = ()  # held out like val and test, at times between training times
    notes: tuple[str, ...] = field(default=())  # what the reader skipped or assumed, as sentences
    content_hash: str = ""  # sha256 over the files that were read, independent of the folder's path

    def split(self, name: Split) -> tuple[Frame, ...]:
        """Frames of one split."""
        return {"train": self.train, "val": self.val, "test": self.test, "between": self.between}[name]

    def __iter__(self) -> Iterator[tuple[Split, Frame]]:
        for name in SPLITS:
            for frame in self.split(name):
                yield name, frame

    @property
    def times(self) -> NDArray[np.float64]:
        """Distinct training times, ascending, [T]."""
        return np.unique(np.array([frame.time for frame in self.train], dtype=np.float64))
