"""Orientation: whether pictures with an EXIF orientation are used as stored or turned.

COLMAP ignores the tag; programs that convert pictures first obey it. Where the size of the camera fits only one of the
two, it decides.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, Literal

from graings.capture.image_file import ImageFile

Orientation = Literal["auto", "stored", "upright"]

# Downscaling rounds the size of an image to whole pixels: aspect ratios may differ by this many px of the shorter side.
ROUNDING_TOLERANCE: Final = 1.0


def image_scale(image: ImageFile, width: float, height: float) -> tuple[float, float] | None:
    """Size of `image` over the size in px for which its intrinsics are given; None where the aspect ratios differ."""
    sx, sy = image.width / width, image.height / height
    return None if abs(sx - sy) * min(width, height) > ROUNDING_TOLERANCE else (sx, sy)


def oriented(image: ImageFile, width: float | None, height: float | None, orientation: Orientation) -> ImageFile:
    """`image`, turned if `orientation` says so or if only then it fits a camera of `width` x `height` px."""
    if image.orientation == 1 or orientation == "stored":
        return image
    turned = image.turned()
    if orientation == "upright":
        return turned
    if width is None or height is None or image_scale(image, width, height) is not None:
        return image
    return image if image_scale(turned, width, height) is None else turned


def named_size(image: ImageFile) -> str:
    """Width, height and EXIF orientation of `image` for a message."""
    tag = "" if image.orientation == 1 else f" (EXIF orientation {image.orientation})"
    return f"{image.width}x{image.height}{tag}"


def orientation_notes(images: Iterable[ImageFile]) -> list[str]:
    """What was done with pictures that have an EXIF orientation."""
    tagged = [image for image in images if image.orientation != 1]
    turned = sum(image.upright for image in tagged)
    notes = []
    if turned:
        notes.append(f"{turned} pictures are turned by their EXIF orientation ({tagged[0].orientation})")
    if turned < len(tagged):
        notes.append(
            f"{len(tagged) - turned} pictures have an EXIF orientation ({tagged[0].name}: {tagged[0].orientation}) and "
            "are used as stored, as COLMAP does; if the cameras are for the pictures as viewers show them, set "
            "capture.orientation=upright"
        )
    return notes
