"""render: the one path from a scene to a picture.

Training, evaluation and serving all pass here; scene and rasterizer meet nowhere else. Knows
nothing of images on disk, losses or HTTP.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from graings.camera import Camera
from graings.raster.rasterize import rasterize
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings, RenderResult
from graings.scene.scene import Composition, Scene


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
        return draw(scene.compose(camera.center, time), camera, background, settings=settings)


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
    """Variance in px^2 that `camera` adds to both axes of a footprint, for a low-pass as wide as in training.

    A picture of half the size with the pixels' own low-pass would show everything dilated: on trained scenes that costs
    4 to 12 dB, and a picture of twice the size loses 1 to 8 (docs/experiments.md).
    """
    return composition.blur * (camera.fx * camera.fy / composition.sampling)
