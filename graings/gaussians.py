"""Gaussians: the batch that the rasterizer draws, at one instant."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """N anisotropic Gaussians, one row each; all floating tensors share dtype (float32 or float64).

    `uids` are persistent numbers that break ties of depth, so that the image does not depend on the order of rows.
    Raises `ValueError` for a wrong shape or dtype.
    """

    means: Float[Tensor, "gaussian 3"]  # centres, normalised world units
    quats: Float[Tensor, "gaussian 4"]  # rotations (w, x, y, z), any length > 0; normalised when drawn
    log_scales: Float[Tensor, "gaussian 3"]  # natural log of the standard deviations, normalised units
    opacities: Float[Tensor, " gaussian"]  # peak alpha before the 0.99 cap; <= 1/255 is not drawn
    colors: Float[Tensor, "gaussian 3"]  # RGB in [0, 1]
    uids: Int64[Tensor, " gaussian"]

    def __post_init__(self) -> None:
        n = self.means.shape[0] if self.means.ndim == 2 else -1
        for name, width in (("means", 3), ("quats", 4), ("log_scales", 3), ("opacities", 0), ("colors", 3)):
            tensor: Tensor = getattr(self, name)
            expected = (n, width) if width else (n,)
            if n < 0 or tuple(tensor.shape) != expected:
                wanted = f"(N, {width})" if width else "(N,)"
                raise ValueError(f"{name} must have shape {wanted}, got {tuple(tensor.shape)}")
            if tensor.dtype not in (torch.float32, torch.float64) or tensor.dtype != self.means.dtype:
                raise ValueError(f"{name} must be float32 or float64 like means, got {tensor.dtype}")
        if tuple(self.uids.shape) != (n,) or self.uids.dtype != torch.int64:
            raise ValueError(f"uids must be int64 of shape (N,), got {self.uids.dtype} {tuple(self.uids.shape)}")

    def __len__(self) -> int:
        return int(self.means.shape[0])
