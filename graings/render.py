"""render: the one path from a scene to a picture.

Training, evaluation and serving all pass here; scene and rasterizer meet nowhere else. Knows
nothing of images on disk, losses or HTTP.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from graings.camera.camera import Camera
from graings.raster.rasterize import rasterize
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings, RenderResult
from graings.scene.scene import Composition, Scene

MOST_PIXELS: Final = 1 << 23  # drawn for a picture that asks for fewer: four for each of 1920 x 1080, in 200 MB


def render(
    scene: Scene,
    camera: Camera,
    time: float,
    background: Sequence[float],
    *,
    settings: RasterSettings | None = None,
) -> RenderResult:
    """The scene at `time` in [0, 1] from `camera` on a `background` RGB in [0, 1], without gradients."""
    with torch.inference_mode():
        return picture(scene.compose(camera.center, time), camera, background, settings=settings)


def picture(
    composition: Composition,
    camera: Camera,
    background: Sequence[float],
    *,
    settings: RasterSettings | None = None,
) -> RenderResult:
    """As `draw`, without gradients, for any size and distance: pixels coarser than training's are means of finer ones.

    A rasterizer looks at the middles of pixels only, and what the model knows lies between them: drawn at once, a
    picture of half the size is 2 to 7 dB worse, and one of a quarter 8 to 17 (docs/experiments/). The networks take
    most of a picture's time, so that the finer pixels hardly cost any.
    """
    parts = supersampling(composition, camera)
    with torch.no_grad():
        if parts == 1:
            return draw(composition, camera, background, settings=settings)
        height, width = camera.height, camera.width
        fine = draw(composition, camera.resized(parts * width, parts * height), background, settings=settings)
        return replace(
            fine,
            color=_averaged(fine.color, parts),
            alpha=_averaged(fine.alpha, parts),
            means2d=fine.means2d / parts,
            radii=fine.radii / parts,
        )


def supersampling(composition: Composition, camera: Camera) -> int:
    """Into how many parts, along each side, a pixel of `camera` has to be divided to be as fine as in training."""
    bearable = max(1, math.isqrt(MOST_PIXELS // (camera.width * camera.height)))
    return max(1, math.ceil(min(composition.sampling.undersampling(camera), bearable)))


def _averaged(fine: Float[Tensor, "fine_height fine_width *channel"], parts: int) -> Tensor:
    """Means of `parts` x `parts` pixels; one axis after the other, which torch does several times faster."""
    height, width = fine.shape[0] // parts, fine.shape[1] // parts
    rows = fine.view(height, parts, -1).sum(1).view(height, width, parts, *fine.shape[2:])
    total: Tensor = sum(rows.unbind(2), start=torch.zeros((), dtype=rows.dtype))
    return total / parts**2


def draw(
    composition: Composition,
    camera: Camera,
    background: Sequence[float],
    *,
    means2d_offset: Float[Tensor, "gaussian 2"] | None = None,
    settings: RasterSettings | None = None,
) -> RenderResult:
    """Rasterize a composition, without depth; gradients flow to it and to `means2d_offset` (pixels).

    The low-pass is always that of the composition, in this camera's pixels.
    """
    gaussians = composition.gaussians
    return rasterize(
        gaussians,
        camera,
        torch.tensor(list(background), dtype=gaussians.means.dtype),
        means2d_offset=means2d_offset,
        settings=replace(settings or DEFAULT_SETTINGS, blur=low_pass(composition, camera)),
        depth=False,
    )


def low_pass(composition: Composition, camera: Camera) -> float:
    """Variance in px^2 that `camera` adds to both axes of a footprint: as wide on the scene in every picture.

    The composition's own where the camera looks as finely as training's reference. With as much in the pixels of every
    camera, a picture of twice the size shows the gaps that training had closed, and far views of training widen what
    near ones want narrow: 1 to 8 dB (docs/experiments/).
    """
    relative_rate = composition.sampling.relative_rate(camera)
    return composition.blur * relative_rate * relative_rate  # a power would raise where this is infinite
