"""render: the one path from a scene to an image.

Training, evaluation and serving all use it; the last two draw a prepared scene, whose images have the same bits. Scene
and rasterizer meet nowhere else.
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
from graings.camera.frustum import Frustum
from graings.camera.sampling_rate import SamplingRate
from graings.gaussians import Gaussians
from graings.raster.rasterize import rasterize
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings, RenderResult
from graings.scene.fast_scene import FastScene as FastScene
from graings.scene.prepared import PreparedScene as PreparedScene  # part of this module's interface too
from graings.scene.scene import Composed, Scene
from graings.scene.splats import Splats

# Upper bound of the supersampled image: four pixels for each of 1920 x 1080, in 200 MB.
MAX_SUPERSAMPLED_PIXELS: Final = 1 << 23


def render(
    scene: Scene | PreparedScene | Splats,
    camera: Camera,
    time: float,
    background: Sequence[float],
    *,
    settings: RasterSettings | None = None,
    depth: bool = False,
) -> RenderResult:
    """The scene at `time` in [0, 1] from `camera` on a `background` RGB in [0, 1], without gradients.

    With `depth` the result has depth too.

    A `Scene` is prepared for this one image. Whoever renders more of them prepares it once (`PreparedScene`).
    """
    prepared = PreparedScene(scene) if isinstance(scene, Scene) else scene
    with torch.inference_mode():
        if isinstance(prepared, PreparedScene):
            composition = prepared.compose(camera.center, time, _frustum(prepared.scene, camera, settings))
        else:
            composition = prepared.compose(camera.center, time)
        return render_composition(composition, camera, background, settings=settings, depth=depth)


def render_composition(
    composition: Composed,
    camera: Camera,
    background: Sequence[float],
    *,
    settings: RasterSettings | None = None,
    depth: bool = False,
) -> RenderResult:
    """As `draw`, without gradients and antialiased: a view coarser than the training views is supersampled.

    The rasterizer samples only the centre of each pixel. Without supersampling an image of half the training size is 2
    to 7 dB worse, and one of a quarter 8 to 17 dB (docs/experiments/).
    """
    parts = supersampling(composition, camera)
    with torch.no_grad():
        if parts == 1:
            return draw(composition, camera, background, settings=settings, depth=depth)
        height, width = camera.height, camera.width
        finer = camera.resized(parts * width, parts * height)
        fine = draw(composition, finer, background, settings=settings, depth=depth)
        return replace(
            fine,
            color=_box_average(fine.color, parts),
            alpha=_box_average(fine.alpha, parts),
            depth=None if fine.depth is None else _box_average(fine.depth, parts),
            means2d=fine.means2d / parts,
            radii=fine.radii / parts,
        )


def supersampling(composition: Composed, camera: Camera) -> int:
    """Samples per pixel along each axis that make `camera` sample the scene as finely as the training views did."""
    if composition.sampling is None:
        return 1
    limit = max(1, math.isqrt(MAX_SUPERSAMPLED_PIXELS // (camera.width * camera.height)))
    return max(1, math.ceil(min(composition.sampling.undersampling(camera), limit)))


def _box_average(fine: Float[Tensor, "fine_height fine_width *channel"], parts: int) -> Tensor:
    """Means of `parts` x `parts` pixels; one axis after the other, which is several times faster in torch."""
    height, width = fine.shape[0] // parts, fine.shape[1] // parts
    rows = fine.view(height, parts, -1).sum(1).view(height, width, parts, *fine.shape[2:])
    total: Tensor = sum(rows.unbind(2), start=torch.zeros((), dtype=rows.dtype))
    return total / parts**2


def draw(
    composition: Composed,
    camera: Camera,
    background: Sequence[float],
    *,
    means2d_offset: Float[Tensor, "gaussian 2"] | None = None,
    settings: RasterSettings | None = None,
    depth: bool = False,
) -> RenderResult:
    """Rasterize a composition, without depth unless asked for; gradients flow to it and to `means2d_offset` (pixels).

    The low-pass filter is that of the composition for this camera (`low_pass`); `settings.blur` is not used.
    """
    gaussians = composition.gaussians
    return rasterize(
        gaussians,
        camera,
        torch.tensor(list(background), dtype=gaussians.means.dtype),
        means2d_offset=means2d_offset,
        settings=replace(settings or DEFAULT_SETTINGS, blur=low_pass(composition, camera)),
        depth=depth,
    )


def low_pass(composition: Composed, camera: Camera) -> float:
    """Variance in px^2 of the low-pass filter for `camera`: a constant width in the scene, not in pixels.

    It equals the composition's own `blur` at the reference sampling rate of the training views. A constant width in
    pixels loses 1 to 8 dB (docs/experiments/): an image of twice the size shows gaps between Gaussians, and distant
    training views widen Gaussians that near views need narrow.
    """
    return _low_pass(composition.blur, composition.sampling, camera)


def _low_pass(blur: float, sampling: SamplingRate | None, camera: Camera) -> float:
    if sampling is None:
        return blur
    relative_rate = sampling.relative_rate(camera)
    return blur * relative_rate * relative_rate  # a power would raise where this is infinite


def _frustum(scene: Scene, camera: Camera, settings: RasterSettings | None) -> Frustum | None:
    """What `camera` may see of `scene`; None where footprints have no end."""
    settings = settings or DEFAULT_SETTINGS
    blur = _low_pass(scene.config.blur, scene.sampling, camera)
    if settings.alpha_min == 0 or not math.isfinite(blur):
        return None
    highest = 1.0 + (0.0 if scene.residual is None else scene.residual.scale)
    reach = max(3.0, math.sqrt(2.0 * math.log(highest / settings.alpha_min)))
    return Frustum(
        camera, near=(1.0 - 1e-6) * settings.near, reach=1.01 * reach, blur=blur, margin=settings.frustum_margin
    )


def contributions(view: Composed, camera: Camera) -> Float[Tensor, " gaussian"]:
    """Sum over the pixels of `camera` of each Gaussian's blending weight, in px."""
    found = view.gaussians
    tensors = (found.means, found.quats, found.log_scales, found.opacities, found.colors)
    means, quats, log_scales, opacities, colors = (tensor.clone() for tensor in tensors)
    with torch.enable_grad():
        colors.requires_grad_()
        gaussians = Gaussians(means, quats, log_scales, opacities, colors, found.uids.clone())
        image = draw(Composed(gaussians, view.children, view.blur, view.sampling), camera, (0.0, 0.0, 0.0)).color
        return torch.autograd.grad(image[..., 0].sum(), colors)[0][:, 0]
