"""Image encoding: an image array as the bytes of a file.

`png`, `jpeg` and `webp` have 8 bits per channel, `exr` half floats, and 32 bits for the depth channel Z. Alpha is
premultiplied in `exr` and straight in `png` and `webp`, as their standards say. No transfer function is applied. PNG
is written here: differences of rows leave long runs in a rendered image, and run lengths are found in a quarter of
the time that OpenImageIO's encoder takes at its lowest level, in fewer bytes.
"""

from __future__ import annotations

import struct
import tempfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio
from numpy.typing import ArrayLike

ImageFormat = Literal["png", "jpeg", "webp", "exr"]
FORMATS: Final[tuple[ImageFormat, ...]] = get_args(ImageFormat)

MEDIA_TYPES: Final[dict[ImageFormat, str]] = {
    "png": "image/png",
    "jpeg": "image/jpeg",
    "webp": "image/webp",
    "exr": "image/x-exr",
}
# OpenImageIO's default quality for WebP, 100, takes seconds for a noisy image; 80 takes milliseconds.
QUALITIES: Final[dict[ImageFormat, int]] = {"jpeg": 92, "webp": 80}

PNG_LEVELS: Final = range(10)

# Names of an image's channels by their number.
CHANNELS: Final[dict[int, tuple[str, ...]]] = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}
LAYERS: Final = ("R", "G", "B", "A", "Z")
DEPTH: Final = "Z"
_PNG_KINDS: Final = {1: 0, 3: 2, 4: 6}


def image_format(name: str) -> ImageFormat:
    """The format of a name like `png`, a suffix like `.jpg` or a media type like `image/webp`.

    Raises `ValueError` naming the supported formats.
    """
    plain = name.strip().lower().removeprefix(".")
    plain = {"jpg": "jpeg", "image/jpg": "jpeg", "image/exr": "exr"}.get(plain, plain)
    for known in FORMATS:
        if plain in (known, MEDIA_TYPES[known]):
            return known
    raise ValueError(f"image format {name!r} is not known, choose one of {', '.join(FORMATS)}")


def library_problem(source: Any) -> str:
    """The last error of `source`, an image of OpenImageIO or the library itself, in one line."""
    try:
        return " ".join(source.geterror().split())
    except UnicodeDecodeError:  # it quotes the file, whose bytes need not be text
        return "its header is damaged"


def encode_image(
    color: ArrayLike,
    format: ImageFormat = "png",
    *,
    channels: Sequence[str] | None = None,
    quality: int | None = None,
    png_level: int | None = None,
) -> bytes:
    """The file contents for `color` [H, W, C] in [0, 1]; values outside are clipped, except in `exr`.

    C is 1 (grey), 3 (RGB) or 4 (RGB premultiplied by alpha, and alpha; not `jpeg`). For `exr`, `channels` names any
    channels, such as `LAYERS`. `quality` (1 to 100) applies to `jpeg` and `webp`, `png_level` (0 to 9, as in zlib;
    None: run lengths only, the fastest) to `png`. Raises `ValueError` for a wrong shape, a non-finite image, an unknown
    format, or a quality or level out of range or for another format.
    """
    image = np.asarray(color, dtype=np.float32)
    names = CHANNELS.get(image.shape[-1] if image.ndim == 3 else 0) if channels is None else tuple(channels)
    if names is None or image.ndim != 3 or image.shape[2] != len(names) or image.size == 0:
        raise ValueError(f"color must have shape (H, W, 1, 3 or 4), or channels as named, got {image.shape}")
    if not np.isfinite(image).all():
        raise ValueError("color must be finite")
    if format not in FORMATS:
        raise ValueError(f"image format {format!r} is not known, choose one of {', '.join(FORMATS)}")
    if format != "exr" and names not in CHANNELS.values():
        raise ValueError(f"{format} cannot hold the channels {', '.join(names)}; choose exr")
    if format == "jpeg" and "A" in names:
        raise ValueError("jpeg has no transparency; choose png, webp or exr")
    if quality is not None and (format not in QUALITIES or not 1 <= quality <= 100):
        raise ValueError(f"quality must lie in [1, 100] and is for jpeg and webp only, got {quality} for {format}")
    if png_level is not None and (format != "png" or png_level not in PNG_LEVELS):
        raise ValueError(f"png_level must lie in [0, 9] and is for png only, got {png_level} for {format}")
    if format == "exr":
        return _by_library(image, format, names, None)
    if "A" in names:  # straight
        alpha = image[..., 3:]
        image = np.concatenate([image[..., :3] / np.where(alpha > 0, alpha, 1.0), alpha], axis=2)
    levels = np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    return _png(levels, png_level) if format == "png" else _by_library(levels, format, names, quality)


def _by_library(image: npt.NDArray[Any], format: ImageFormat, names: tuple[str, ...], quality: int | None) -> bytes:
    """The file as OpenImageIO writes it."""
    height, width = image.shape[:2]
    if format == "webp" and len(names) == 1:
        image, names = np.repeat(image, 3, axis=2), CHANNELS[3]
    spec = oiio.ImageSpec(width, height, len(names), oiio.HALF if format == "exr" else oiio.UINT8)
    spec.channelnames = names
    if format == "exr":
        spec.attribute("compression", "zip")
        kinds = tuple(oiio.FLOAT if name == DEPTH else oiio.HALF for name in names)
        if len(set(kinds)) > 1:
            spec.channelformats = kinds
        else:
            spec.set_format(kinds[0])
    else:
        spec.attribute("Compression", f"{format}:{quality or QUALITIES[format]}")
        spec.attribute("oiio:UnassociatedAlpha", 1)
    # OpenImageIO's Python module can only write to a path.
    with tempfile.TemporaryDirectory(prefix="graings-") as folder:
        path = Path(folder) / f"image.{format}"
        output = oiio.ImageOutput.create(str(path))
        if output is None:
            raise ValueError(f"this build of OpenImageIO cannot write {format}: {oiio.geterror()}")
        if not (output.open(str(path), spec) and output.write_image(np.ascontiguousarray(image)) and output.close()):
            raise OSError(f"OpenImageIO could not write {format}: {output.geterror()}")
        return path.read_bytes()


def _png(pixels: npt.NDArray[np.uint8], level: int | None) -> bytes:
    """The file of `pixels` [H, W, C]; every row but the first as its difference from the row above (filter `Up`)."""
    height, width, channels = pixels.shape
    rows = pixels.reshape(height, width * channels)
    filtered = np.empty((height, 1 + width * channels), dtype=np.uint8)
    filtered[:, 0] = 2
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])
    strategy = zlib.Z_RLE if level is None else zlib.Z_DEFAULT_STRATEGY
    deflate = zlib.compressobj(1 if level is None else level, zlib.DEFLATED, zlib.MAX_WBITS, 9, strategy)
    data = deflate.compress(filtered.tobytes()) + deflate.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, _PNG_KINDS[channels], 0, 0, 0)  # 8 bits, not interlaced
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
