"""Captures of fixed cameras whose images a test draws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import CaptureConfig
from graings.plan.capture_statistics import CaptureStatistics, measure
from tests.capture.captures import entry, orbit, write_image, write_transforms

WHITE = (1.0, 1.0, 1.0)
Draw = Callable[[int, int], NDArray[np.floating]]  # camera, time index -> image [H, W, 3 or 4] in [0, 1]


def write_fixed(folder: Path, draw: Draw, *, cameras: int = 1, times: int = 8, size: int = 64) -> Path:
    """`cameras` on a ring that stay in place and see `times` instants each; none is held out."""
    frames = []
    for camera in range(cameras):
        for index in range(times):
            name = f"train/c{camera}_{index:03d}"
            image = np.rint(255 * np.clip(draw(camera, index), 0, 1)).astype(np.uint8)
            write_image(folder / f"{name}.png", image)
            frames.append(entry(orbit(camera, max(cameras, 4), (size, size)), name, index / max(1, times - 1)))
    write_transforms(folder, "train", frames)
    write_transforms(folder, "val", [])
    return folder


def texture(size: int = 64, seed: int = 0) -> NDArray[np.float64]:
    """A smooth pattern [size, size, 3] with contrast everywhere."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / size
    waves = [np.sin(2 * np.pi * (a * x + b * y) + c) for a, b, c in random.uniform(-4, 4, (6, 3))]
    return np.stack([0.5 + 0.08 * sum(np.roll(waves, channel, 0)[:4]) for channel in range(3)], axis=-1)


def statistics_of(folder: Path) -> CaptureStatistics:
    capture = load_capture(folder, CaptureConfig())
    return measure(capture, ImageStore(WHITE), WHITE)


def noisy(image: NDArray[np.floating], sigma: float, *seed: int) -> NDArray[np.float64]:
    """`image` with normal noise of its own for each seed."""
    return image + np.random.default_rng(seed).normal(0, sigma, image.shape)


def shifted(image: NDArray[np.floating], px: float) -> NDArray[np.float64]:
    """`image` moved to the right by a fraction of a pixel, interpolated linearly."""
    whole = int(np.floor(px))
    near, far = np.roll(image, whole, axis=1), np.roll(image, whole + 1, axis=1)
    return (1 - (px - whole)) * near + (px - whole) * far


def square(image: NDArray[np.floating], left: int, top: int, side: int, color: Sequence[float]) -> NDArray[np.floating]:
    """`image` with a square of one colour."""
    drawn = image.copy()
    drawn[top : top + side, left : left + side, :3] = color
    return drawn
