"""rasterize: the image of a batch of Gaussians, drawn by the compiled kernel.

This is the torch side only: checks, buffers and autograd. `graings.raster.reference` defines the image, and tests
compare the kernel with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from graings import kernel
from graings.camera.camera import Camera
from graings.gaussians import Gaussians
from graings.raster.arguments import check_arguments
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings, RenderResult


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    background: Float[Tensor, " 3"],
    *,
    means2d_offset: Float[Tensor, "gaussian 2"] | None = None,
    settings: RasterSettings = DEFAULT_SETTINGS,
    depth: bool = True,
    threads: int | None = None,
) -> RenderResult:
    """Draw `gaussians` seen by `camera` on `background` (RGB, same dtype); Eq. (1) and (2).

    `means2d_offset` is added to the projected centres (pixels): pass zeros that require a gradient to obtain the
    gradient in screen space. A Gaussian that is not drawn receives a gradient of exactly zero. With `depth` False
    the result's depth is None. `threads` is the number of CPU threads (None: the kernel's default); the result has
    the same bits for any number. Pixels are computed in the dtype of the Gaussians, geometry always in float64.

    The backward pass frees the memory it needed: a second one through a retained graph draws the image again.

    Raises `ValueError` for a wrong shape, dtype or device, `KernelError` when the kernel is not built.
    """
    check_arguments(gaussians, background, means2d_offset, threads)
    tensors = (
        gaussians.means,
        gaussians.quats,
        gaussians.log_scales,
        gaussians.opacities,
        gaussians.colors,
        background,
        means2d_offset,
    )
    workers = kernel.thread_count() if threads is None else threads
    if torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in tensors):
        return RenderResult(*_Rasterize.apply(*tensors, gaussians.uids, camera, settings, depth, workers))  # type: ignore[no-untyped-call]
    inputs = [_prepared(tensor) for tensor in (*tensors, gaussians.uids)]
    frame, images = _draw(inputs, camera, settings, depth, workers, gradient=False)
    return RenderResult(*images, frame.culled)


Images = tuple[Tensor, Tensor, Tensor | None, Tensor, Tensor]  # color, alpha, depth, means2d, radii


def _prepared(tensor: Tensor | None) -> Tensor | None:
    """Contiguous memory with resolved signs, as the kernel reads it."""
    if tensor is None:
        return None
    if tensor._is_zerotensor():  # autograd's zeros have no memory
        tensor = tensor.clone()
    return tensor.contiguous().resolve_neg()


def _addresses(*tensors: Tensor | None) -> list[int]:
    """Memory addresses of prepared tensors; 0 for None."""
    return [0 if tensor is None else tensor.data_ptr() for tensor in tensors]


def _draw(
    inputs: Sequence[Tensor | None],
    camera: Camera,
    settings: RasterSettings,
    depth: bool,
    threads: int,
    *,
    gradient: bool,
) -> tuple[Any, Images]:
    """The kernel's frame, which with `gradient` keeps what the backward pass needs, and the images.

    `inputs` are prepared tensors: means, quats, log_scales, opacities, colors, background, offset or None, uids.
    """
    means = inputs[0]
    assert means is not None
    n, height, width = len(means), camera.height, camera.width
    images = (
        means.new_empty(height, width, 3),
        means.new_empty(height, width),
        means.new_empty(height, width) if depth else None,
        means.new_empty(n, 2),
        means.new_empty(n, 2),
    )
    module = kernel.kernel()
    draw = module.draw_float if means.dtype == torch.float32 else module.draw_double
    frame = draw(
        n,
        *_addresses(*inputs),
        camera.world_to_camera,
        camera.center,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        width,
        height,
        settings.alpha_min,
        settings.transmittance_min,
        settings.alpha_max,
        settings.blur,
        settings.near,
        settings.far,
        settings.frustum_margin,
        settings.compat,
        *_addresses(*images),
        threads,
        gradient,
    )
    return frame, images


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor | None, Tensor, Tensor, dict[str, int]]:
        *tensors, camera, settings, depth, threads = arguments
        inputs = [_prepared(tensor) for tensor in tensors]
        frame, images = _draw(inputs, camera, settings, depth, threads, gradient=True)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(*images[3:])
        ctx.save_for_backward(*inputs)
        ctx.frame, ctx.view, ctx.threads = frame, (camera, settings), threads
        return (*images, frame.culled)

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, v_color: Tensor | None, v_alpha: Tensor | None, v_depth: Tensor | None, *_: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        if v_color is None and v_alpha is None and v_depth is None:
            return (None,) * 12
        means, quats, log_scales, opacities, colors, background, offset, _ = ctx.saved_tensors
        inputs = (means, quats, log_scales, opacities, colors)
        camera, settings = ctx.view
        # A frame serves one backward pass. A second or concurrent one through a retained graph draws again.
        frame = ctx.__dict__.pop("frame", None)
        if frame is None:
            frame, _ = _draw(ctx.saved_tensors, camera, settings, False, ctx.threads, gradient=True)
        upstream = means.new_zeros(camera.height, camera.width, 3) if v_color is None else v_color
        upstreams = [_prepared(v) for v in (upstream, v_alpha, v_depth)]
        v_background = torch.empty_like(background) if ctx.needs_input_grad[len(inputs)] else None
        frame.pixels_gradient(*_addresses(background, *upstreams, v_background), ctx.threads)
        # Allocated only now, because pixels_gradient has freed memory of the frame that they can reuse.
        gradients = [torch.empty_like(tensor) for tensor in inputs]
        v_offset = None if offset is None else torch.empty_like(offset)
        addresses = _addresses(*inputs, background, offset, *gradients, v_offset)
        frame.gaussians_gradient(len(means), *addresses, ctx.threads)
        return (*gradients, v_background, v_offset, None, None, None, None, None)
