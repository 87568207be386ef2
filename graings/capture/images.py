"""ImageStore: pixels of frames, decoded on demand and held in a bounded cache.

Decode, undistort, shrink by exact area average on premultiplied alpha, composite on the background; masks likewise
(`graings.capture.mask`). The cache holds 16-bit integers, half the memory of float32; rounding changes a value by at
most 0.002 levels of 255, and opaque pixels of 8 or 16 bits at their original size not at all.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from graings.capture.capture import Frame
from graings.capture.image_file import decode
from graings.capture.mask import ALL, Mask, read_mask, undistorted
from graings.errors import CaptureError

Image = NDArray[np.float32]
Quantized = NDArray[np.uint16]
ImageKey = tuple[Path, int, int]  # file, width and height after shrinking
Part = Literal["rgb", "alpha", "valid"]
PartKey = tuple[Path, int, int, Part]

LEVELS: Final = np.float32(65535)  # the quantized value of 1


@dataclass(frozen=True, slots=True, eq=False)
class _Pixels:
    """One decoded image [H, W, 3]; alpha and valid pixels [H, W] are None where they are 1 everywhere."""

    rgb: Quantized
    alpha: Quantized | None
    valid: Mask | None


class ImageStore:
    """Images of a capture on one background; safe to share between threads."""

    def __init__(self, background: Sequence[float], cache_mb: int = 1024) -> None:
        self._background = np.asarray(background, dtype=np.float32).reshape(3)
        self._quantized_background = _quantize(self._background)
        self._background_is_rounded = bool((_dequantize(self._quantized_background) != self._background).any())
        self._limit = cache_mb * 1_000_000
        self._lock = threading.Lock()
        self._cache: OrderedDict[PartKey, Quantized | Mask | None] = OrderedDict()
        self._bytes = 0
        self._prefetcher = ThreadPoolExecutor(1, "decoder")
        self._pending: dict[ImageKey, Future[_Pixels]] = {}

    def prefetch(self, frame: Frame) -> None:
        """Start decoding `frame` on another thread; an error is raised by the next `rgb` or `alpha` of the frame."""
        key = _image_key(frame)
        with self._lock:
            if (*key, "rgb") not in self._cache and key not in self._pending:
                self._pending[key] = self._prefetcher.submit(self._load, frame)

    def rgb(self, frame: Frame) -> Image:
        """Colour [H, W, 3] in [0, 1] on the background, at the size of the frame's camera, in steps of 1/65535.

        Raises `CaptureError` where the file has changed or was damaged since the capture was loaded.
        """
        quantized = self._get(frame, "rgb")
        assert quantized is not None  # only alpha may be absent
        image = _dequantize(quantized)
        if self._background_is_rounded:  # background pixels must equal those of a render without Gaussians exactly
            np.copyto(image, self._background, where=quantized == self._quantized_background)
        return image

    def alpha(self, frame: Frame) -> Image | None:
        """Alpha [H, W] in [0, 1] at the size of the frame's camera; None without an alpha channel.

        A channel that is opaque everywhere counts as none: many programs write one by default.
        """
        quantized = self._get(frame, "alpha")
        return None if quantized is None else _dequantize(quantized)

    def valid(self, frame: Frame) -> Mask | None:
        """Pixels [H, W] that take part in losses and metrics; None where all do.

        A pixel averaged from several of the file is valid where all of them are.
        """
        return None if frame.mask_path is None else self._get(frame, "valid")

    @property
    def cached_bytes(self) -> int:
        """Memory of the cached arrays in bytes."""
        return self._bytes

    def _get(self, frame: Frame, part: Part) -> NDArray[Any] | None:
        key = _image_key(frame)
        part_key = (*key, part)
        with self._lock:
            pending = self._pending.pop(key, None)
            if part_key in self._cache:
                self._cache.move_to_end(part_key)
                return self._cache[part_key]
        # Outside the lock, so that threads decode in parallel; rarely two threads decode the same frame.
        pixels = self._load(frame) if pending is None else pending.result()
        with self._lock:
            self._add_to_cache((*key, "valid"), pixels.valid)
            self._add_to_cache((*key, "alpha"), pixels.alpha)
            self._add_to_cache((*key, "rgb"), pixels.rgb)
        return {"rgb": pixels.rgb, "alpha": pixels.alpha, "valid": pixels.valid}[part]

    def _add_to_cache(self, key: PartKey, image: NDArray[Any] | None) -> None:
        if key in self._cache:
            return
        self._cache[key] = image
        self._bytes += 0 if image is None else image.nbytes
        while self._bytes > self._limit and self._cache:
            _, dropped = self._cache.popitem(last=False)
            self._bytes -= 0 if dropped is None else dropped.nbytes

    def _load(self, frame: Frame) -> _Pixels:
        pixels = decode(frame.image_path, frame.name, frame.orientation)
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
        valid = _valid(frame)
        if pixels.shape[2] == 3:
            return _Pixels(_quantize(pixels), None, valid)
        alpha = pixels[..., 3]
        rgb = pixels[..., :3] + self._background * (1.0 - alpha)[..., None]
        quantized_alpha = _quantize(alpha)
        opaque = (quantized_alpha == LEVELS).all()
        return _Pixels(_quantize(np.minimum(rgb, np.float32(1.0))), None if opaque else quantized_alpha, valid)


def _valid(frame: Frame) -> Mask | None:
    if frame.mask_path is None:
        return None
    share = undistorted(read_mask(frame.mask_path, frame.mask_path.name, frame.source_size), frame.lens)
    valid = np.asarray(shrink(share, frame.camera.width, frame.camera.height)[..., 0] >= ALL)
    return None if valid.all() else valid


def _quantize(image: Image) -> Quantized:
    return np.ascontiguousarray(np.rint(image * LEVELS).astype(np.uint16))


def _dequantize(quantized: Quantized) -> Image:
    return np.divide(quantized, LEVELS, dtype=np.float32)


def _image_key(frame: Frame) -> ImageKey:
    return frame.image_path, frame.camera.width, frame.camera.height


def shrink(image: Image, width: int, height: int) -> Image:
    """`image` [H, W, C] averaged over `height` x `width` equal cells; the ratio of sizes need not be whole."""
    if image.shape[:2] == (height, width):
        return image
    if image.shape[0] % height == 0 and image.shape[1] % width == 0:
        return _block_means(image, image.shape[0] // height, image.shape[1] // width)
    return _cell_means(_cell_means(image, height, 0), width, 1).astype(np.float32)


def _block_means(image: Image, rows: int, columns: int) -> Image:
    """Means of cells of `rows` x `columns` whole pixels, the common case: plain sums are several times faster."""
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
    # The k-th pixel of all cells at once: few operations on long arrays, in float64 to round to float32 only once.
    for pixel in range(int(np.ceil(edges[1:] - first).max())):
        index = first + pixel
        overlap = np.minimum(edges[1:], index + 1) - np.maximum(edges[:-1], index)
        weight = np.clip(overlap, 0.0, None) * (cells / size)
        weight = weight[:, None, None] if axis == 0 else np.repeat(weight[:, None], values.shape[2], axis=1)
        total = total + np.take(values, np.minimum(index, size - 1), axis=axis) * weight
    return total
