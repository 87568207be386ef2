"""Masks: which pixels of an image take part in losses, metrics and first points.

A mask is an image of its own that is black where pixels are to be ignored, as nerfstudio's `mask_path` and COLMAP's
`masks/` have it. It is not alpha: a transparent pixel is known to be empty, a masked one is unknown.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.capture.image_file import ImageFile, decode
from graings.capture.lens import Lens
from graings.capture.orientation import image_scale
from graings.errors import CaptureError

Mask = NDArray[np.bool_]

# A pixel that is averaged from several is valid where all of them are; rounding takes less than this.
ALL: Final = 1.0 - 1e-4


def check_mask(mask: ImageFile, image: ImageFile) -> None:
    """Raise `CaptureError` naming `mask` where it has another aspect ratio than `image`."""
    if image_scale(image, mask.width, mask.height) is None:
        raise CaptureError(
            f"is a mask of {mask.width}x{mask.height} px for {image.name}, which has {image.width}x{image.height}",
            file=mask.name,
            field="size",
            remedy="Make the mask from the image itself.",
        )


def read_mask(path: Path, name: str, size: tuple[int, int]) -> Mask:
    """Valid pixels [H, W] of an image of `size` (width, height): those brighter than half of the mask's brightest.

    Masks are written as 0 and 1 as well as 0 and 255. Raises `CaptureError` where the file cannot be decoded.
    """
    values = decode(path, name)[..., :3].max(axis=-1)
    valid = values > 0.5 * values.max()
    rows = (np.arange(size[1]) + 0.5) * valid.shape[0] / size[1]
    columns = (np.arange(size[0]) + 0.5) * valid.shape[1] / size[0]
    return np.asarray(valid[np.ix_(rows.astype(np.intp), columns.astype(np.intp))])


def undistorted(valid: Mask, lens: Lens | None) -> NDArray[np.float32]:
    """The share [H, W, 1] of valid pixels in each pixel of the undistorted image."""
    share = valid[..., None].astype(np.float32)
    return share if lens is None else lens.undistort(share)
