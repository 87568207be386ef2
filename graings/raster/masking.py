"""Masked pixels in a comparison of two images: they are made equal, and carry no gradient."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Image = Float[Tensor, "height width 3"]


def without_masked(image: Image, target: Image, valid: Bool[Tensor, "height width"]) -> tuple[Image, Image, float]:
    """`image` and `target` with the masked pixels of both as `image` shows them, and the share of valid pixels.

    Masked pixels then differ by nothing, windows of SSIM that reach into them compare the valid part, and no gradient
    reaches them. A mean difference over all pixels divided by the share is that over the valid ones; of SSIM, windows
    around masked pixels near valid ones count too. The share of an image without a valid pixel is 1, so that its mean
    of 0 stays 0.
    """
    kept, fixed = valid.unsqueeze(-1), image.detach()
    share = float(valid.double().mean()) or 1.0
    return torch.where(kept, image, fixed), torch.where(kept, target, fixed), share
