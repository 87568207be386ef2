"""Photographs of a folder as frames: upright, no larger than needed, with the times of their EXIF tags."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import OpenImageIO as oiio

from graings.constants import MAX_IMAGE_PIXELS, MAX_IMAGE_SIDE
from graings.errors import CaptureError
from graings.footage.frame_document import FootageFrame
from graings.footage.sharpness import WIDTH, sharpness
from graings.image_encoding import encode_image, library_problem
from graings.storage.files import write_bytes

SUFFIXES: Final = {".png", ".jpg", ".jpeg", ".jfif", ".webp", ".tif", ".tiff", ".heic", ".heif", ".avif", ".bmp"}
PNG_LEVEL: Final = 1


def photographs(folder: Path) -> list[Path]:
    """The images of `folder` that are not hidden, in order of their names, in which digits count as numbers."""
    visible = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted((path for path in visible if path.suffix.lower() in SUFFIXES and path.is_file()), key=_by_number)


def _by_number(path: Path) -> tuple[list[str | int], str]:
    """A key that sorts frame2 before frame10."""
    parts = re.split(r"([0-9]+)", path.name.casefold())
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], path.name


def convert_photographs(
    photos: list[Path], target: Path, max_side: int, observe: Callable[[int, int], None]
) -> tuple[tuple[FootageFrame, ...], tuple[str, ...]]:
    """Write `photos` to the folder `target` as PNG, no side above `max_side` px, turned as their EXIF tag says.

    Times are those of the EXIF tags where all photographs have one that tells them apart, else their numbers; the
    second value names which. Raises `CaptureError` naming a file that cannot be read.
    """
    frames, taken = [], []
    for index, photo in enumerate(photos):
        image, time = _read(photo, max_side)
        pixels = np.asarray(image.get_pixels(oiio.FLOAT))
        if not np.isfinite(pixels).all():
            raise CaptureError("holds values that are not finite", file=photo, remedy="Export it again, or remove it.")
        rgb = np.repeat(pixels[..., :1], 3, axis=2) if pixels.shape[2] < 3 else pixels[..., :3]
        luma = (rgb @ np.array([0.299, 0.587, 0.114], np.float32) * 255).clip(0, 255).astype(np.uint8)
        step = max(1, luma.shape[1] // WIDTH)
        name = f"{index:05d}.png"
        write_bytes(target / name, encode_image(rgb, "png", png_level=PNG_LEVEL))
        frames.append(FootageFrame(name=name, time=float(index), sharpness=sharpness(luma[::step, ::step])))
        taken.append(time)
        observe(index + 1, len(photos))
    known = [time for time in taken if time is not None]
    if len(known) < len(taken):
        return tuple(frames), ("the photographs have no times of their own: their order by name is taken as time",)
    times = [time.seconds for time in known]
    told_apart = len(set(times)) == len(times)
    # Two cameras may see the same moment; but a fraction that is the same everywhere, as "00", tells nothing.
    fractions = {time.fraction for time in known}
    if not told_apart and (None in fractions or len(fractions) == 1):
        reason = "several photographs have the same EXIF time, which has no fractions of a second"
        return tuple(frames), (f"{reason}: their order by name is taken as time",)
    frames = [frame.model_copy(update={"time": t - min(times)}) for frame, t in zip(frames, times, strict=True)]
    return tuple(sorted(frames, key=lambda frame: frame.time)), ("times are those of the EXIF tags",)


def image_size(image: Path) -> tuple[int, int]:
    """Width and height in px of a readable image as it is stored."""
    spec = oiio.ImageBuf(str(image)).spec()
    return spec.width, spec.height


class ExifTime(NamedTuple):
    """When a photograph was taken, in seconds, and the fraction of a second in its tags, if they have one."""

    seconds: float
    fraction: float | None


def _read(photo: Path, max_side: int) -> tuple[oiio.ImageBuf, ExifTime | None]:
    """The upright image at its final size, and its EXIF time."""
    image = oiio.ImageBuf(str(photo))
    size = image.spec()
    if max(size.width, size.height) > MAX_IMAGE_SIDE or size.width * size.height > MAX_IMAGE_PIXELS:
        problem = f"is {size.width}x{size.height} px, more than {MAX_IMAGE_PIXELS} px in total"
        raise CaptureError(problem, file=photo, remedy="Scale it down, or remove it.")
    if not image.read(convert=oiio.FLOAT):
        remedy = "Convert it to JPEG or PNG, or remove it."
        raise CaptureError(f"cannot be read as an image ({library_problem(image)})", file=photo, remedy=remedy)
    time = _time(size)
    scale = max_side / max(size.width, size.height)
    if scale < 1:
        roi = oiio.ROI(0, max(1, round(size.width * scale)), 0, max(1, round(size.height * scale)))
        image = oiio.ImageBufAlgo.resize(image, roi=roi)
    return oiio.ImageBufAlgo.reorient(image), time  # last: it copies the image


def _time(spec: oiio.ImageSpec) -> ExifTime | None:
    # Not DateTime: of TIFF and PNG it is when the file was written, and OpenImageIO itself writes it.
    text = spec.getattribute("Exif:DateTimeOriginal")
    if not text:
        return None
    try:
        moment = datetime.datetime.strptime(str(text), "%Y:%m:%d %H:%M:%S").replace(tzinfo=datetime.UTC)
    except ValueError:
        return None  # a tag that some programs leave empty or write in words
    digits = str(spec.getattribute("Exif:SubsecTimeOriginal") or "").strip()
    fraction = float(f"0.{digits}") if digits.isdecimal() else None
    return ExifTime(moment.timestamp() + (fraction or 0.0), fraction)
