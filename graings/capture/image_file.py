"""ImageFile: one image on disk, checked for completeness and size, and its pixels.

Formats are recognised by content, not by name. Stored values are not converted: 8 bit as x/255, 16 bit as x/65535,
floats clipped to [0, 1] without a transfer curve.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from graings.constants import MAX_IMAGE_PIXELS, MAX_IMAGE_SIDE
from graings.errors import CaptureError
from graings.image_encoding import library_problem

# Suffixes that a listed name may lack or have instead of another, in the order in which they are tried.
SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".exr", ".jfif", ".webp", ".tif", ".tiff", ".bmp", ".gif", ".tga")
# Pictures that are not read. They are looked for as well, so that the message can say why.
UNREADABLE_SUFFIXES: Final = (".heic", ".heif", ".avif", ".dng", ".hdr")

PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE: Final = b"\xff\xd8\xff"
EXR_SIGNATURE: Final = b"\x76\x2f\x31\x01"
# These have no end marker that could be followed: they are decoded once.
DECODED_ONCE: Final = (EXR_SIGNATURE, b"RIFF", b"II*\0", b"MM\0*", b"II+\0", b"MM\0+", b"BM", b"GIF8")
# Formats whose alpha is straight though OpenImageIO does not say so.
ALWAYS_STRAIGHT: Final = ("bmp", "gif")
# Where the mask of alpha is in a BMP, and the kinds of compression for which it counts.
BMP_ALPHA_MASK: Final = slice(66, 70)
BMP_BIT_FIELDS: Final = (3, 6)
# The fourth to twelfth byte of containers for photographs whose decoders are not part of OpenImageIO's package.
PHOTO_CONTAINERS: Final = {b"heic": "HEIC", b"heix": "HEIC", b"mif1": "HEIC", b"msf1": "HEIC", b"avif": "AVIF"}


@dataclass(frozen=True, slots=True)
class ImageFile:
    """A checked image; `name` is relative to the capture.

    `orientation` is the EXIF code: how a viewer turns the stored pixels. They are used as stored, as COLMAP does,
    unless `upright`; width and height are those of the pixels as used.
    """

    path: Path
    name: str
    width: int
    height: int
    has_alpha: bool
    orientation: int = 1
    upright: bool = False

    def turned(self) -> ImageFile:
        """The same image, turned as the EXIF code says."""
        swaps = self.orientation >= 5
        width, height = (self.height, self.width) if swaps else (self.width, self.height)
        return replace(self, width=width, height=height, upright=True)


def check_image(path: Path, name: str, data: bytes) -> ImageFile:
    """The header of the image at `path` whose contents are `data`, after a check that it is complete.

    PNG chunks and JPEG segments are followed to their end marker, because decoders fill a truncated JPEG with grey
    without an error; other formats have no end marker and are decoded once. Raises `CaptureError` for truncated,
    damaged, too large and unsupported images.
    """
    if data.startswith(PNG_SIGNATURE):
        complete = _png_is_complete(data)
    elif data.startswith(JPEG_SIGNATURE):
        complete = _jpeg_is_complete(data)
    else:
        complete = bool(data)
        if complete and not data.startswith(DECODED_ONCE) and path.suffix.lower() != ".tga":
            kind = PHOTO_CONTAINERS.get(data[8:12]) if data[4:8] == b"ftyp" else None
            raise CaptureError(
                f"is a {kind} picture, which is not read" if kind else "is no image of a known format",
                file=name,
                remedy="Convert it to PNG or JPEG (PNG, JPEG, OpenEXR, WebP, TIFF, BMP, GIF and TGA are read).",
            )
    if not complete:
        raise _damaged(name, "is truncated or damaged")
    source = _open(path, name)
    spec = source.spec()
    source.close()
    code = spec.get_int_attribute("Orientation", 1)
    if data.startswith((PNG_SIGNATURE, JPEG_SIGNATURE)):
        has_alpha = _channels(spec, name)[1] is not None
    else:
        has_alpha = decode(path, name).shape[2] == 4
    return ImageFile(path, name, spec.width, spec.height, has_alpha, code if 1 <= code <= 8 else 1)


def decode(path: Path, name: str, orientation: int = 1) -> NDArray[np.float32]:
    """Pixels [H, W, 3] or, where there is an alpha channel, [H, W, 4] premultiplied; float32 in [0, 1].

    They are turned by the EXIF code `orientation`; 1: as stored. Raises `CaptureError` where the file cannot be decoded
    or holds a value that is not finite.
    """
    source = _open(path, name)
    spec = source.spec()
    color, alpha = _channels(spec, name)
    stored = source.read_image(0, 0, 0, spec.nchannels, spec.format)
    problem = library_problem(source)
    # PNG and WebP say so, EXR is premultiplied, TIFF either; of BMP and GIF the library says nothing.
    straight = spec.get_int_attribute("oiio:UnassociatedAlpha") == 1 or source.format_name() in ALWAYS_STRAIGHT
    may_be_unused = source.format_name() == "bmp" and not _bmp_declares_alpha(path)
    source.close()
    if stored is None or problem:
        raise _damaged(name, f"cannot be decoded ({problem})")
    stored = np.asarray(stored).reshape(spec.height, spec.width, spec.nchannels)
    if alpha is not None and may_be_unused and not stored[..., alpha].any():
        alpha = None
    pixels = stored[..., color if alpha is None else [*color, alpha]].astype(np.float32)
    if np.issubdtype(stored.dtype, np.integer):
        pixels /= np.float32(np.iinfo(stored.dtype).max)
    elif not np.isfinite(pixels).all():
        raise CaptureError("holds values that are not finite", file=name, remedy="Export the image again.")
    else:
        np.clip(pixels, 0.0, 1.0, out=pixels)
    if alpha is not None and straight:
        pixels[..., :3] *= pixels[..., 3:]
    return pixels if orientation == 1 else _turned(pixels, orientation)


def _turned(pixels: NDArray[np.float32], orientation: int) -> NDArray[np.float32]:
    """`pixels` as a viewer shows them: EXIF codes 5 to 8 exchange rows and columns, and each code mirrors some axes."""
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def _open(path: Path, name: str) -> oiio.ImageInput:
    # Without this option OpenImageIO premultiplies PNG colours in 8 bit, which rounds dark ones to black.
    options = oiio.ImageSpec()
    options["oiio:UnassociatedAlpha"] = 1
    source = oiio.ImageInput.open(str(path), options)
    if source is None:
        raise _damaged(name, f"cannot be opened ({library_problem(oiio)})")
    spec = source.spec()
    if max(spec.width, spec.height) > MAX_IMAGE_SIDE or spec.width * spec.height > MAX_IMAGE_PIXELS:
        raise CaptureError(
            f"is {spec.width}x{spec.height} px, more than {MAX_IMAGE_SIDE} px per side or {MAX_IMAGE_PIXELS} in total",
            file=name,
            field="size",
            remedy="Scale the images down.",
        )
    if spec.deep or spec.depth != 1:
        raise CaptureError("is a deep or volume image", file=name, remedy="Flatten it.")
    # Of other formats the offset says where the picture was cut from; the file holds all that is left.
    part = (spec.x, spec.y, spec.full_width, spec.full_height) != (0, 0, spec.width, spec.height)
    if part and source.format_name() == "openexr":
        raise CaptureError(
            "contains only a part of its frame (data window differs from display window)",
            file=name,
            field="size",
            remedy="Export the full frame.",
        )
    return source


def _channels(spec: oiio.ImageSpec, name: str) -> tuple[list[int], int | None]:
    """Indices of the three colour channels (grey three times) and of alpha, or None."""
    names = list(spec.channelnames)
    last = names.index("A") if "A" in names else spec.alpha_channel  # the index is wrong for GIF
    alpha = last if 0 <= last < len(names) else None
    if {"R", "G", "B"} <= set(names):
        return [names.index(c) for c in "RGB"], alpha
    if len(names) - (alpha is not None) == 1:
        return [int(alpha == 0)] * 3, alpha
    raise CaptureError(
        f"has the channels {', '.join(names)}",
        file=name,
        field="channels",
        remedy="Export it as grey or RGB, with or without alpha.",
    )


def _bmp_declares_alpha(path: Path) -> bool:
    """Whether the header names the bits of alpha. Else they are alpha by custom, or unused and 0 everywhere."""
    with path.open("rb") as file:
        header = file.read(BMP_ALPHA_MASK.stop)
    size, compression = (int.from_bytes(header[at : at + 4], "little") for at in (14, 30))
    has_masks = size >= BMP_ALPHA_MASK.stop - 14 and compression in BMP_BIT_FIELDS
    return has_masks and any(header[BMP_ALPHA_MASK])


def _png_is_complete(data: bytes) -> bool:
    at = len(PNG_SIGNATURE)
    view = memoryview(data)
    while at + 12 <= len(data):
        size = int.from_bytes(view[at : at + 4], "big")
        kind, end = bytes(view[at + 4 : at + 8]), at + 12 + size
        if end > len(data) or zlib.crc32(view[at + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            return False
        if kind == b"IEND":
            return True
        at = end
    return False


def _jpeg_is_complete(data: bytes) -> bool:
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == 0xFF:  # fill byte
            at += 1
            continue
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at + 1] == 0xDA:  # start of scan: coded data contains no marker, so the next end marker is the end
            return data.find(b"\xff\xd9", end) >= 0
        at = end
    return False


def _damaged(name: str, problem: str) -> CaptureError:
    return CaptureError(problem, file=name, remedy="Copy or export the image again.")
