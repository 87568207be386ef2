"""The oracle: the picture by brute force, in plain torch.

Every Gaussian is evaluated at every pixel, in float64, and autograd takes the derivative. It is slow and
obviously right; the kernel must agree with it. Culling, order and stopping are those of the kernel because
both follow the same rules, not because they share code. Knows nothing of threads or instruction sets.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from graings.camera.camera import Camera
from graings.constants import TILE
from graings.gaussians import Gaussians
from graings.raster.arguments import check_arguments
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings, RenderResult

# Elements of one [pixel, gaussian] matrix: a dozen of them in float64 live at once, about 100 MB.
CHUNK_ELEMENTS = 1 << 20

# Below this squared norm a quaternion has no direction left in float32.
MIN_SQUARED_QUAT = 1e-24


@dataclass(frozen=True, slots=True)
class _Footprints:
    """Projected Gaussians, one row each, all float64: e(d) = (dx - slope dy)^2 / (2 v) + dy^2 / (2 c)."""

    means2d: Tensor  # [n, 2] px
    slope: Tensor  # regression of x on y
    v: Tensor  # variance of x given y, px^2
    c: Tensor  # variance of y, px^2
    a: Tensor  # variance of x, px^2
    depths: Tensor

    def finite(self) -> Tensor:
        columns = (*self.means2d.unbind(1), self.slope, self.v, self.c, self.a, self.depths)
        return torch.stack(columns, 1).isfinite().all(1)


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    background: Tensor,
    *,
    means2d_offset: Tensor | None = None,
    settings: RasterSettings = DEFAULT_SETTINGS,
    depth: bool = True,
    threads: int | None = None,
) -> RenderResult:
    """Draw `gaussians` seen by `camera` on `background` [3]; same contract as `graings.raster.rasterize`.

    `threads` is accepted for the common signature and ignored.
    """
    check_arguments(gaussians, background, means2d_offset, threads)
    dtype, n = gaussians.means.dtype, len(gaussians)
    means, quats, log_scales = gaussians.means.double(), gaussians.quats.double(), gaussians.log_scales.double()
    opacities, colors, ground = gaussians.opacities.double(), gaussians.colors.double(), background.double()
    offset = torch.zeros(n, 2, dtype=torch.float64) if means2d_offset is None else means2d_offset.double()

    with torch.no_grad():
        drawn, culled = _cull(means, quats, log_scales, opacities, colors, offset, camera, settings)
        z = _in_camera(means[drawn], camera)[:, 2]
        by_uid = torch.argsort(gaussians.uids[drawn], stable=True)
        drawn = drawn[by_uid][torch.argsort(z[by_uid], stable=True)]

    prints = _project(means[drawn], quats[drawn], log_scales[drawn], offset[drawn], camera, settings)
    pixels = _pixel_centres(camera)
    size = max(1, CHUNK_ELEMENTS // max(1, len(drawn)))
    parts = [
        cast(
            Tensor,
            checkpoint(
                _composite, chunk, prints, opacities[drawn], colors[drawn], ground, settings, use_reentrant=False
            ),
        )
        for chunk in pixels.split(size)
    ]
    image = torch.cat(parts).reshape(camera.height, camera.width, 5).to(dtype)

    with torch.no_grad():
        means2d = torch.zeros(n, 2, dtype=torch.float64).index_copy(0, drawn, prints.means2d)
        radii = torch.zeros(n, 2, dtype=torch.float64).index_copy(0, drawn, _radii(prints, opacities[drawn], settings))
    drawn_depth = image[..., 4] if depth else None
    return RenderResult(image[..., :3], image[..., 3], drawn_depth, means2d.to(dtype), radii.to(dtype), culled)


def _cull(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    offset: Tensor,
    camera: Camera,
    settings: RasterSettings,
) -> tuple[Tensor, dict[str, int]]:
    """Indices of what is drawn and the reasons for the rest; each Gaussian is counted at its first reason."""
    everything = torch.cat([means, quats, log_scales, opacities[:, None], colors, offset], 1)
    squared = (quats * quats).sum(1)
    largest = torch.cat([log_scales.exp(), _in_camera(means, camera)[:, 2:].abs()], 1).amax(1)
    finite = everything.isfinite().all(1) & squared.isfinite() & (largest <= settings.far)
    turned = squared >= MIN_SQUARED_QUAT
    in_front = _in_camera(means, camera)[:, 2] > settings.near
    visible = opacities > settings.alpha_min
    alive = (finite & turned & in_front & visible).nonzero()[:, 0]

    prints = _project(means[alive], quats[alive], log_scales[alive], offset[alive], camera, settings)
    bounded = prints.finite()
    inside = _touches_image(prints, opacities[alive], camera, settings)
    culled = {
        "non_finite": int((~finite).sum() + (~bounded).sum()),
        "zero_quat": int((finite & ~turned).sum()),
        "behind": int((finite & turned & ~in_front).sum()),
        "faint": int((finite & turned & in_front & ~visible).sum()),
        "outside": int((bounded & ~inside).sum()),
    }
    return alive[bounded & inside], culled


def _in_camera(means: Tensor, camera: Camera) -> Tensor:
    """Rw (x - centre): the difference first, so that a far-off scene does not cancel."""
    pose = torch.tensor(camera.world_to_camera)
    return (means - torch.tensor(camera.center)) @ pose[:3, :3].T


def _rotations(quats: Tensor) -> Tensor:
    """Rotation matrices [n, 3, 3] of the normalised quaternions (w, x, y, z)."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, 1) for row in rows], 1)


def _project(
    means: Tensor, quats: Tensor, log_scales: Tensor, offset: Tensor, camera: Camera, settings: RasterSettings
) -> _Footprints:
    """EWA projection in sheared form: no inverse, and a determinant without a subtraction."""
    x, y, z = _in_camera(means, camera).unbind(1)
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    rx, ry = x / z, y / z
    margin_x, margin_y = (settings.frustum_margin * 0.5 * size for size in (camera.width, camera.height))
    hx = rx.clamp(-(cx + margin_x) / fx, (camera.width - cx + margin_x) / fx)
    hy = ry.clamp(-(cy + margin_y) / fy, (camera.height - cy + margin_y) / fy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * hx / z], 1), torch.stack([zero, fy / z, -fy * hy / z], 1)], 1
    )
    world_to_camera = torch.tensor(camera.world_to_camera)[:3, :3]
    factor = jacobian @ world_to_camera @ _rotations(quats) * log_scales.exp()[:, None, :]  # covariance = F F^T
    m1, m2 = factor.unbind(1)
    xx, yy, xy = (m1 * m1).sum(1), (m2 * m2).sum(1), (m1 * m2).sum(1)
    across = torch.linalg.cross(m1, m2)
    h = settings.blur
    c = yy + h
    determinant = h * h + h * (xx + yy) + (across * across).sum(1)  # Lagrange's identity
    means2d = torch.stack([fx * rx + cx, fy * ry + cy], 1) + offset
    return _Footprints(means2d, xy / c, determinant / c, c, xx + h, z)


def _radii(prints: _Footprints, opacities: Tensor, settings: RasterSettings) -> Tensor:
    """Half-widths [n, 2] in px of the box beyond which alpha < alpha_min; compat: of the 3-sigma square."""
    if settings.compat:
        covariance = prints.slope * prints.c
        mean, half = 0.5 * (prints.a + prints.c), 0.5 * (prints.a - prints.c)
        largest = mean + torch.hypot(half, covariance)
        return (3 * largest.sqrt()).ceil()[:, None].expand(-1, 2)
    if settings.alpha_min == 0:
        return torch.full((len(opacities), 2), math.inf, dtype=torch.float64)
    level = 2 * (opacities / settings.alpha_min).log()
    return (level[:, None] * torch.stack([prints.a, prints.c], 1)).sqrt()


def _tile_range(prints: _Footprints, radii: Tensor) -> tuple[Tensor, Tensor]:
    """compat: first and one-past-last tile touched by the square, as the public rasterizers count them."""
    return ((prints.means2d - radii) / TILE).floor(), ((prints.means2d + radii) / TILE).ceil()


def _touches_image(prints: _Footprints, opacities: Tensor, camera: Camera, settings: RasterSettings) -> Tensor:
    """Whether the footprint reaches a pixel centre, with a pixel of slack on each side."""
    radii = _radii(prints, opacities, settings)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    if settings.compat:
        first, last = _tile_range(prints, radii)
        tiles = (size / TILE).ceil()
        return (first.clamp(min=0) < torch.minimum(last, tiles)).all(1)
    low, high = prints.means2d - radii, prints.means2d + radii
    return ((low <= size + 0.5) & (high >= -0.5)).all(1)


def _pixel_centres(camera: Camera) -> Tensor:
    columns = torch.arange(camera.width, dtype=torch.float64) + 0.5
    rows = torch.arange(camera.height, dtype=torch.float64) + 0.5
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).reshape(-1, 2)


def _composite(
    pixels: Tensor, prints: _Footprints, opacities: Tensor, colors: Tensor, ground: Tensor, settings: RasterSettings
) -> Tensor:
    """Front to back over Gaussians in order, [pixel, 5]: colour, alpha, depth."""
    dx, dy = (pixels[:, None, :] - prints.means2d).unbind(2)
    r = dx - prints.slope * dy
    raw = opacities * torch.exp(-(r * r / (2 * prints.v) + dy * dy / (2 * prints.c)))
    counts = raw >= settings.alpha_min
    if settings.compat:
        first, last = _tile_range(prints, _radii(prints, opacities, settings))
        tile = (pixels / TILE).floor()[:, None, :]
        counts = counts & ((tile >= first) & (tile < last)).all(2)
    alpha = torch.where(counts, raw.clamp(max=settings.alpha_max), 0.0)
    one = torch.ones(len(pixels), 1, dtype=torch.float64)
    with torch.no_grad():
        through = torch.cat([one, 1 - alpha], 1).cumprod(1)
        tested = through[:, 1:] if settings.compat else through[:, :-1]
        blended = tested >= settings.transmittance_min
    alpha = torch.where(blended, alpha, 0.0)
    through = torch.cat([one, 1 - alpha], 1).cumprod(1)
    weights, left = alpha * through[:, :-1], through[:, -1:]
    return torch.cat([weights @ colors + left * ground, 1 - left, weights @ prints.depths[:, None]], 1)
