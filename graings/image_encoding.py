"""Image encoding: an image array as the bytes of a file.

`png`, `jpeg` and `webp` have 8 bits per channel, `exr` half floats. No transfer function is applied.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
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

# Deflate at its lowest level: twice as fast as the default for a few per cent more bytes.
PNG_LEVEL: Final = 1


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


def encode_image(color: ArrayLike, format: ImageFormat = "png", *, quality: int | None = None) -> bytes:
    """The file contents for `color` [H, W, 3] in [0, 1]; values outside are clipped, except in `exr`.

    `quality` (1 to 100) applies to `jpeg` and `webp`. Raises `ValueError` for a wrong shape, a non-finite image, an
    unknown format, or a quality out of range or for another format.
    """
    image = np.asarray(color, dtype=np.float32)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"color must have shape (H, W, 3), got {image.shape}")
    if not np.isfinite(image).all():
        raise ValueError("color must be finite")
    if format not in FORMATS:
        raise ValueError(f"image format {format!r} is not known, choose one of {', '.join(FORMATS)}")
    if quality is not None and (format not in QUALITIES or not 1 <= quality <= 100):
        raise ValueError(f"quality must lie in [1, 100] and is for jpeg and webp only, got {quality} for {format}")
    pixels = image if format == "exr" else np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    height, width = image.shape[:2]
    spec = oiio.ImageSpec(width, height, 3, oiio.HALF if format == "exr" else oiio.UINT8)
    if format == "exr":
        spec.attribute("compression", "zip")
    elif format == "png":
        spec.attribute("png:compressionLevel", PNG_LEVEL)
    else:
        spec.attribute("Compression", f"{format}:{quality or QUALITIES[format]}")
    # OpenImageIO's Python module can only write to a path.
    with tempfile.TemporaryDirectory(prefix="graings-") as folder:
        path = Path(folder) / f"image.{format}"
        output = oiio.ImageOutput.create(str(path))
        if output is None:
            raise ValueError(f"this build of OpenImageIO cannot write {format}: {oiio.geterror()}")
        if not (output.open(str(path), spec) and output.write_image(np.ascontiguousarray(pixels)) and output.close()):
            raise OSError(f"OpenImageIO could not write {format}: {output.geterror()}")
        return path.read_bytes()
