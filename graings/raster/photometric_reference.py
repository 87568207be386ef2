"""The oracle of `graings.raster.photometric`: a plain two-dimensional convolution in float64, with autograd."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def ssim(image: Tensor, target: Tensor, *, threads: int | None = None) -> Tensor:
    """Mean SSIM of two [H, W, 3] images; `threads` is accepted for the common signature and ignored."""
    x, y = (t.double().permute(2, 0, 1)[:, None] for t in (image, target))
    position = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    taps = torch.exp(-(position**2) / (2 * SIGMA**2))
    taps = taps / taps.sum()
    window = torch.outer(taps, taps)[None, None]

    def blur(maps: Tensor) -> Tensor:
        return conv2d(maps, window, padding=WINDOW // 2)

    mean_x, mean_y = blur(x), blur(y)
    variance_x = (blur(x * x) - mean_x * mean_x).clamp(min=0)
    variance_y = (blur(y * y) - mean_y * mean_y).clamp(min=0)
    covariance = blur(x * y) - mean_x * mean_y
    value = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    value = value / ((mean_x**2 + mean_y**2 + C1) * (variance_x + variance_y + C2))
    return value.clamp(-1, 1).mean().to(image.dtype)


def photometric(
    image: Tensor, target: Tensor, ssim_weight: float, squared_weight: float = 0.0, *, threads: int | None = None
) -> Tensor:
    """(1 - w) |image - target|_1 + w (1 - SSIM) + q (image - target)^2; `threads` is ignored."""
    difference = image.double() - target.double()
    absolute, squared = (mean.to(image.dtype) for mean in (difference.abs().mean(), difference.square().mean()))
    return (1.0 - ssim_weight) * absolute + ssim_weight * (1.0 - ssim(image, target)) + squared_weight * squared
