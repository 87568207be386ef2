"""ImageStore: pixels of frames, decoded when asked for, kept in a bounded cache.

Decode, undistort, shrink by exact area average on premultiplied alpha, composite on the background. Kept as 16-bit
numbers, half the memory of float32; rounding costs at most 0.002 levels of 255, and nothing for opaque pixels of 8 or
16 bits at their own size. Knows nothing of splits, poses or training.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.capture.capture import Frame
from graings.capture.image_file import decode
from graings.errors import CaptureError

Image = NDArray[np.float32]
Kept = NDArray[np.uint16]
Picture = tuple[Path, int, int]
Key = tuple[Path, int, int, str]

STEPS: Final = np.float32(65535)  # of what is kept, from 0 to 1


class ImageStore:
    """Images of a capture on one background; safe to share between threads."""

    def __init__(self, background: Sequence[float], cache_mb: int = 1024) -> None:
        self._background = np.asarray(background, dtype=np.float32).reshape(3)
        self._kept_background = _kept(self._background)
        self._between_steps = bool((_shown(self._kept_background) != self._background).any())
        self._limit = cache_mb * 1_000_000
        self._lock = threading.Lock()
        self._cache: OrderedDict[Key, Kept | None] = OrderedDict()
        self._bytes = 0
        self._ahead = ThreadPoolExecutor(1, "decoder")
        self._coming: dict[Picture, Future[tuple[Kept, Kept | None]]] = {}

    def prefetch(self, frame: Frame) -> None:
        """Begin to decode a frame that is wanted next, on another thread; who asks for it is told what went wrong."""
        picture = _picture(frame)
        with self._lock:
            if (*picture, "rgb") not in self._cache and picture not in self._coming:
                self._coming[picture] = self._ahead.submit(self._load, frame)

    def rgb(self, frame: Frame) -> Image:
        """Colour [H, W, 3] in [0, 1] on the background, at the size of the frame's camera, in steps of 1/65535.

        Raises `CaptureError` where the file has changed or broken since the capture was loaded.
        """
        kept = self._get(frame, "rgb")
        assert kept is not None  # only alpha may be absent
        image = _shown(kept)
        if self._between_steps:  # nothing in sight has the very colour of a render in which nothing is drawn
            np.copyto(image, self._background, where=kept == self._kept_background)
        return image

    def alpha(self, frame: Frame) -> Image | None:
        """Coverage [H, W] in [0, 1] at the size of the frame's camera; None where nothing is said to be transparent.

        Many files have an alpha channel that is opaque everywhere, and mean no more by it than those without one.
        """
        kept = self._get(frame, "alpha")
        return None if kept is None else _shown(kept)

    @property
    def cached_bytes(self) -> int:
        """Memory the cached arrays take."""
        return self._bytes

    def _get(self, frame: Frame, part: str) -> Kept | None:
        picture = _picture(frame)
        key = (*picture, part)
        with self._lock:
            coming = self._coming.pop(picture, None)
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        # Outside the lock: threads decode side by side; two asking for the same frame do the work twice, rarely.
        rgb, alpha = self._load(frame) if coming is None else coming.result()
        with self._lock:
            self._keep((*picture, "alpha"), alpha)
            self._keep((*picture, "rgb"), rgb)
        return rgb if part == "rgb" else alpha

    def _keep(self, key: Key, image: Kept | None) -> None:
        if key in self._cache:
            return
        self._cache[key] = image
        self._bytes += 0 if image is None else image.nbytes
        while self._bytes > self._limit and self._cache:
            _, dropped = self._cache.popitem(last=False)
            self._bytes -= 0 if dropped is None else dropped.nbytes

    def _load(self, frame: Frame) -> tuple[Kept, Kept | None]:
        pixels = decode(frame.image_path, frame.name)
        if (pixels.shape[1], pixels.shape[0]) != frame.source_size:
            raise CaptureError(
                f"is {pixels.shape[1]}x{pixels.shape[0]} px, was {frame.source_size[0]}x{frame.source_size[1]} before",
                file=frame.name,
                field="size",
                remedy="Load the capture again.",
            )
        if frame.lens is not None:
            pixels = frame.lens.undistort(pixels)
        pixels = shrink(pixels, frame.camera.width, frame.camera.height)
        if pixels.shape[2] == 3:
            return _kept(pixels), None
        alpha = pixels[..., 3]
        rgb = pixels[..., :3] + self._background * (1.0 - alpha)[..., None]
        coverage = _kept(alpha)
        return _kept(np.minimum(rgb, np.float32(1.0))), None if (coverage == STEPS).all() else coverage


def _kept(image: Image) -> Kept:
    return np.ascontiguousarray(np.rint(image * STEPS).astype(np.uint16))


def _shown(kept: Kept) -> Image:
    return np.divide(kept, STEPS, dtype=np.float32)


def _picture(frame: Frame) -> Picture:
    return frame.image_path, frame.camera.width, frame.camera.height


def shrink(image: Image, width: int, height: int) -> Image:
    """`image` [H, W, C] averaged over the areas of `height` x `width` equal cells, whatever the ratio."""
    if image.shape[:2] == (height, width):
        return image
    if image.shape[0] % height == 0 and image.shape[1] % width == 0:
        return _block_means(image, image.shape[0] // height, image.shape[1] // width)
    return _cell_means(_cell_means(image, height, 0), width, 1).astype(np.float32)


def _block_means(image: Image, rows: int, columns: int) -> Image:
    """Whole pixels to a cell, as in most captures: plain sums are several times as fast."""
    total = np.zeros(image[::rows, ::columns].shape)
    for row in range(rows):
        for column in range(columns):
            total += image[row::rows, column::columns]
    return (total / (rows * columns)).astype(np.float32)


def _cell_means(values: NDArray[np.floating], cells: int, axis: int) -> NDArray[np.float64]:
    size = values.shape[axis]
    edges = np.arange(cells + 1) * size / cells
    first = np.minimum(edges[:-1].astype(np.intp), size - 1)
    total = np.zeros(1)
    # The k-th pixel of every cell at once: few steps on long arrays, in float64 so that rounding stays below float32's.
    for pixel in range(int(np.ceil(edges[1:] - first).max())):
        index = first + pixel
        overlap = np.minimum(edges[1:], index + 1) - np.maximum(edges[:-1], index)
        weight = np.clip(overlap, 0.0, None) * (cells / size)
        weight = weight[:, None, None] if axis == 0 else np.repeat(weight[:, None], values.shape[2], axis=1)
        total = total + np.take(values, np.minimum(index, size - 1), axis=axis) * weight
    return total
