"""The slow reference of `graings.raster.photometric`: a two-dimensional convolution in float64, with autograd."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import conv2d

from graings.constants import SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from graings.raster.masking import without_masked


def ssim(
    image: Float[Tensor, "height width 3"], target: Float[Tensor, "height width 3"], *, threads: int | None = None
) -> Float[Tensor, ""]:
    """Mean SSIM of two images; `threads` is accepted for the common signature and ignored."""
    x, y = (t.double().permute(2, 0, 1)[:, None] for t in (image, target))
    position = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    taps = torch.exp(-(position**2) / (2 * SSIM_SIGMA**2))
    taps = taps / taps.sum()
    window = torch.outer(taps, taps)[None, None]

    def blur(maps: Tensor) -> Tensor:
        return conv2d(maps, window, padding=SSIM_WINDOW // 2)

    mean_x, mean_y = blur(x), blur(y)
    variance_x = (blur(x * x) - mean_x * mean_x).clamp(min=0)
    variance_y = (blur(y * y) - mean_y * mean_y).clamp(min=0)
    covariance = blur(x * y) - mean_x * mean_y
    value = (2 * mean_x * mean_y + SSIM_C1) * (2 * covariance + SSIM_C2)
    value = value / ((mean_x**2 + mean_y**2 + SSIM_C1) * (variance_x + variance_y + SSIM_C2))
    return value.clamp(-1, 1).mean().to(image.dtype)


def photometric(
    image: Float[Tensor, "height width 3"],
    target: Float[Tensor, "height width 3"],
    ssim_weight: float,
    squared_weight: float = 0.0,
    *,
    valid: Bool[Tensor, "height width"] | None = None,
    threads: int | None = None,
) -> Float[Tensor, ""]:
    """(1 - w) |image - target|_1 + w (1 - SSIM) + q (image - target)^2; `threads` is ignored."""
    if valid is not None:
        image, target, share = without_masked(image, target, valid)
        return photometric(image, target, ssim_weight, squared_weight) / share
    difference = image.double() - target.double()
    absolute, squared = (mean.to(image.dtype) for mean in (difference.abs().mean(), difference.square().mean()))
    return (1.0 - ssim_weight) * absolute + ssim_weight * (1.0 - ssim(image, target)) + squared_weight * squared
