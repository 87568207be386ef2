"""How far an image is from its target: structural similarity, absolute and squared difference, with their gradient.

Fused in the compiled kernel. SSIM as 3DGS defines it (`graings.constants`): per channel, with a Gaussian window and
zero padding; local variances are clamped at 0 and local values to [-1, 1], with zero gradient where clamped. Meant for
losses; evaluation uses `graings.evaluation.metrics`, which rounds to 8 bits first.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from graings import kernel
from graings.raster.masking import without_masked


def ssim(
    image: Float[Tensor, "height width 3"], target: Float[Tensor, "height width 3"], *, threads: int | None = None
) -> Float[Tensor, ""]:
    """Mean SSIM over pixels and channels of two images in [0, 1]; a scalar in [-1, 1].

    Differentiable with respect to `image` only. Raises `ValueError` for a wrong shape, dtype or device and for a
    `target` that requires a gradient.
    """
    return _weighted_sum(image, target, 1.0, 0.0, 0.0, threads)


def photometric(
    image: Float[Tensor, "height width 3"],
    target: Float[Tensor, "height width 3"],
    ssim_weight: float,
    squared_weight: float = 0.0,
    *,
    valid: Bool[Tensor, "height width"] | None = None,
    threads: int | None = None,
) -> Float[Tensor, ""]:
    """(1 - w) |image - target|_1 + w (1 - SSIM) + q (image - target)^2, means over pixels and channels.

    w is `ssim_weight`, q `squared_weight`; without q it is Eq. 15. With `valid` the differences are means over its
    pixels, and the others change neither value nor gradient. Of 1 - SSIM all windows that reach a valid pixel are
    summed, divided by the number of valid pixels, so that small valid parts count more (`graings.raster.masking`).
    Other arguments and errors are those of `ssim`.
    """
    if valid is not None:
        image, target, share = without_masked(image, target, valid)
        return photometric(image, target, ssim_weight, squared_weight, threads=threads) / share
    return ssim_weight + _weighted_sum(image, target, -ssim_weight, 1.0 - ssim_weight, squared_weight, threads)


def _weighted_sum(
    image: Tensor, target: Tensor, similarity: float, absolute: float, squared: float, threads: int | None
) -> Tensor:
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"image must have shape (H, W, 3), got {tuple(image.shape)}")
    if target.shape != image.shape:
        raise ValueError(f"target must have the shape of image {tuple(image.shape)}, got {tuple(target.shape)}")
    if image.dtype not in (torch.float32, torch.float64) or target.dtype != image.dtype:
        raise ValueError(f"image and target must both be float32 or float64, got {image.dtype} and {target.dtype}")
    if image.device.type != "cpu" or target.device.type != "cpu":
        raise ValueError(f"image and target must be on the CPU, got {image.device} and {target.device}")
    if target.requires_grad:
        raise ValueError("target must not require a gradient: only the first image is differentiated")
    if threads is not None and threads < 1:
        raise ValueError(f"threads must be at least 1, got {threads}")
    workers = kernel.thread_count() if threads is None else threads
    weights = (similarity, absolute, squared)
    value: Tensor = _Photometric.apply(image, target, weights, workers)  # type: ignore[no-untyped-call]
    return value


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, weights: tuple[float, float, float], threads: int) -> Tensor:
        first, second = image.detach().contiguous(), target.detach().contiguous()
        gradient = torch.empty_like(first) if ctx.needs_input_grad[0] else None
        height, width, _ = image.shape
        means = kernel.call("compare", first, second, height, width, *weights, gradient, threads)
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return image.new_tensor(sum(weight * mean for weight, mean in zip(weights, means, strict=True)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * upstream, None, None, None
