"""picture: what a view shows as the bytes of an image file: colour, transparency, depth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from graings import constants
from graings.camera.camera import Camera
from graings.camera.units import Units
from graings.image_encoding import DEPTH, LAYERS, ImageFormat, encode_image
from graings.raster.result import RenderResult
from graings.render import PreparedScene, render_composition
from graings.scene.scene import Scene
from graings.scene.splats import Splats

Content = Literal["color", "rgba", "alpha", "depth", "layers"]
CONTENTS: Final[tuple[Content, ...]] = get_args(Content)

_DARKEST: Final = 0.1  # grey of the farthest depth in a picture; 0 is where nothing is


def check_content(content: Content, format: ImageFormat) -> None:
    """Raises `ValueError` where `format` cannot hold `content`."""
    if content == "layers" and format != "exr":
        raise ValueError(f"layers are written as exr only, not {format}")
    if content == "rgba" and format == "jpeg":
        raise ValueError("jpeg has no transparency; choose png, webp or exr")


def picture(
    scene: Scene | PreparedScene | Splats,
    camera: Camera,
    time: float,
    background: Sequence[float],
    units: Units,
    content: Content,
    format: ImageFormat,
    *,
    note: Callable[[str], None] = lambda part: None,
) -> bytes:
    """The image file of a view at `time` in [0, 1]. `note` is called after each part: scene, raster, encode.

    `color` is on `background`; the others have none. `rgba` is transparent where nothing is. `depth` is the mean
    distance along the viewing axis of what is drawn: in `exr` in the capture's units as 32-bit floats, 0 where nothing
    is; else a picture from white (near) to dark grey (far), black where nothing is. `layers`, for `exr`: R, G, B and A,
    premultiplied, and depth Z. Raises `ValueError` where `format` cannot hold `content`.
    """
    check_content(content, format)
    with torch.no_grad():
        composition = scene.compose(camera.center, time)
    note("scene")
    behind = background if content == "color" else (0.0, 0.0, 0.0)
    drawn = render_composition(composition, camera, behind, depth=content in ("depth", "layers"))
    note("raster")
    image = _encoded(drawn, units, content, format)
    note("encode")
    return image


def _encoded(drawn: RenderResult, units: Units, content: Content, format: ImageFormat) -> bytes:
    if content == "color":
        return encode_image(drawn.color.numpy(), format)
    alpha = drawn.alpha.numpy().astype(np.float32)[..., None]
    rgba = np.concatenate([drawn.color.numpy(), alpha], axis=2)
    if content == "rgba":
        return encode_image(rgba, format)
    if content == "alpha":
        return encode_image(alpha, format)
    depth = _depth(drawn, units)[..., None]
    if content == "layers":
        return encode_image(np.concatenate([rgba, depth], axis=2), format, channels=LAYERS)
    return encode_image(depth, format, channels=[DEPTH]) if format == "exr" else encode_image(_grey(depth), format)


def _depth(drawn: RenderResult, units: Units) -> NDArray[np.float32]:
    """Expected depth in the capture's units; 0 where less than a grey level is drawn."""
    assert drawn.depth is not None
    alpha, depth = drawn.alpha.double().numpy(), drawn.depth.double().numpy()
    there = alpha > constants.ALPHA_MIN
    found: NDArray[np.float32] = np.where(there, depth / np.where(there, alpha, 1.0) / units.scale, 0.0).astype("f4")
    return found


def _grey(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """White for the nearest, `_DARKEST` for the farthest depth of this picture, 0 where it is 0."""
    there = depth > 0
    if not there.any():
        return depth
    near, far = float(depth[there].min()), float(depth[there].max())
    far = max(far, near * (1 + 1e-6))
    return np.where(there, 1.0 - (1.0 - _DARKEST) * (depth - near) / (far - near), 0.0).astype(np.float32)
