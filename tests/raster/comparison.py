"""Runs a rasterizer with gradients, measures differences, and finds pixels where rounding may decide a threshold."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from graings.camera.camera import Camera
from graings.gaussians import Gaussians
from graings.raster import reference
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings, RenderResult
from tests.scenes import FLOATS

UNIT_ROUNDOFF = 2.0**-24  # float32

BACKGROUND = (0.2, 0.5, 0.9)


class Rasterizer(Protocol):
    def __call__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor,
        *,
        means2d_offset: Tensor | None = None,
        settings: RasterSettings = ...,
        threads: int | None = None,
    ) -> RenderResult: ...


@dataclass(frozen=True, slots=True)
class Drawing:
    """An image and the gradient of every input."""

    result: RenderResult
    gradients: dict[str, Tensor]

    def images(self) -> dict[str, Tensor]:
        return {name: getattr(self.result, name).detach() for name in ("color", "alpha", "depth")}


def upstream(camera: Camera, seed: int = 0, *, keep: Tensor | None = None) -> Tensor:
    """Random gradients of (r, g, b, alpha, depth) [H, W, 5], float64; zero outside `keep`."""
    random = torch.Generator().manual_seed(seed)
    value = torch.randn(camera.height, camera.width, 5, generator=random, dtype=torch.float64)
    return value if keep is None else value * keep[..., None]


def draw(
    rasterize: Rasterizer,
    gaussians: Gaussians,
    camera: Camera,
    cotangent: Tensor,
    *,
    settings: RasterSettings = DEFAULT_SETTINGS,
    threads: int = 1,
) -> Drawing:
    """Draw with an offset of zero and back-propagate `cotangent`."""
    dtype = gaussians.means.dtype
    leaves = {name: getattr(gaussians, name).clone().requires_grad_() for name in FLOATS}
    leaves["means2d_offset"] = torch.zeros(len(gaussians), 2, dtype=dtype, requires_grad=True)
    leaves["background"] = torch.tensor(BACKGROUND, dtype=dtype, requires_grad=True)
    result = rasterize(
        replace(gaussians, **{name: leaves[name] for name in FLOATS}),
        camera,
        leaves["background"],
        means2d_offset=leaves["means2d_offset"],
        settings=settings,
        threads=threads,
    )
    image = torch.cat([result.color, result.alpha[..., None], result.depth[..., None]], 2)
    (image * cotangent.to(dtype)).sum().backward()
    return Drawing(result, {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None})


def relative(value: Tensor, expected: Tensor) -> float:
    """Norm of the difference over the norm of `expected`; 0 if both are 0."""
    difference, size = (value.double() - expected.double()).norm().item(), expected.double().norm().item()
    return difference / size if size > 0 else difference


@dataclass(frozen=True, slots=True)
class Decisions:
    """Pixels where a rounding error could reverse a threshold decision, and the largest number of blended Gaussians."""

    steady: Tensor  # [H, W] bool: no contributor within 1e-4 of a threshold
    deepest: int


def decisions(gaussians: Gaussians, camera: Camera, settings: RasterSettings = DEFAULT_SETTINGS) -> Decisions:
    """For the thresholds of alpha_min, of the stop and of the alpha cap (which affects only gradients)."""
    offset = torch.zeros(len(gaussians), 2, dtype=torch.float64)
    values = (gaussians.means, gaussians.quats, gaussians.log_scales)
    drawn, _ = reference._cull(*values, gaussians.opacities, gaussians.colors, offset, camera, settings)
    z = reference._in_camera(gaussians.means[drawn], camera)[:, 2]
    drawn = drawn[torch.argsort(z, stable=True)]
    prints = reference._project(*(v[drawn] for v in values), offset[drawn], camera, settings)
    dx, dy = (reference._pixel_centres(camera)[:, None] - prints.means2d).unbind(2)
    exponent = (dx - prints.slope * dy) ** 2 / (2 * prints.v) + dy**2 / (2 * prints.c)
    raw = gaussians.opacities[drawn] * torch.exp(-exponent)
    alpha = torch.where(raw >= settings.alpha_min, raw.clamp(max=settings.alpha_max), 0.0)
    after = (1 - alpha).cumprod(1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    reached = before >= settings.transmittance_min * (1 - 1e-4)

    def close(value: Tensor, threshold: float) -> Tensor:
        return ((value / threshold - 1).abs() < 1e-4) & reached

    tipping = close(raw, settings.alpha_min) | close(raw, settings.alpha_max)
    tipping |= close(after, settings.transmittance_min)
    blended = ((alpha > 0) & reached).sum(1)
    return Decisions(~tipping.any(1).reshape(camera.height, camera.width), int(blended.max()))
