"""The slow reference rasterizer (oracle): brute force in plain torch.

Every Gaussian is evaluated at every pixel, in float64, and autograd takes the derivative. Tests compare the kernel with
it. It shares no code with the kernel: both follow the same rules of culling, order and stopping.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from graings.camera.camera import Camera
from graings.constants import TILE
from graings.gaussians import Gaussians
from graings.raster.arguments import check_arguments
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings, RenderResult

# Elements of one [pixel, gaussian] matrix. About a dozen such float64 matrices exist at once: 100 MB.
CHUNK_ELEMENTS = 1 << 20

# Below this squared norm the direction of a float32 quaternion is not defined.
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
    background: Float[Tensor, " 3"],
    *,
    means2d_offset: Float[Tensor, "gaussian 2"] | None = None,
    settings: RasterSettings = DEFAULT_SETTINGS,
    depth: bool = True,
    threads: int | None = None,
) -> RenderResult:
    """Draw `gaussians` seen by `camera` on `background`; same contract as `graings.raster.rasterize.rasterize`.

    `threads` is accepted for the common signature and ignored.
    """
    check_arguments(gaussians, background, means2d_offset, threads)
    dtype, n = gaussians.means.dtype, len(gaussians)
    means, quats, log_scales = gaussians.means.double(), gaussians.quats.double(), gaussians.log_scales.double()
    opacities, colors, behind = gaussians.opacities.double(), gaussians.colors.double(), background.double()
    offset = torch.zeros(n, 2, dtype=torch.float64) if means2d_offset is None else means2d_offset.double()

    with torch.no_grad():
        drawn, culled = _cull(means, quats, log_scales, opacities, colors, offset, camera, settings)
        z = _in_camera(means[drawn], camera)[:, 2]
        by_uid = torch.argsort(gaussians.uids[drawn], stable=True)
        drawn = drawn[by_uid][torch.argsort(z[by_uid], stable=True)]

    footprints = _project(means[drawn], quats[drawn], log_scales[drawn], offset[drawn], camera, settings)
    pixels = _pixel_centres(camera)
    size = max(1, CHUNK_ELEMENTS // max(1, len(drawn)))
    parts = [
        cast(
            Tensor,
            checkpoint(
                _composite, chunk, footprints, opacities[drawn], colors[drawn], behind, settings, use_reentrant=False
            ),
        )
        for chunk in pixels.split(size)
    ]
    image = torch.cat(parts).reshape(camera.height, camera.width, 5).to(dtype)

    with torch.no_grad():
        means2d = torch.zeros(n, 2, dtype=torch.float64).index_copy(0, drawn, footprints.means2d)
        radii = torch.zeros(n, 2, dtype=torch.float64).index_copy(
            0, drawn, _radii(footprints, opacities[drawn], settings)
        )
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
    """Indices of the drawn Gaussians, and how many were culled by reason; each counts for its first reason."""
    everything = torch.cat([means, quats, log_scales, opacities[:, None], colors, offset], 1)
    squared = (quats * quats).sum(1)
    largest = torch.cat([log_scales.exp(), _in_camera(means, camera)[:, 2:].abs()], 1).amax(1)
    finite = everything.isfinite().all(1) & squared.isfinite() & (largest <= settings.far)
    has_direction = squared >= MIN_SQUARED_QUAT
    in_front = _in_camera(means, camera)[:, 2] > settings.near
    visible = opacities > settings.alpha_min
    candidates = (finite & has_direction & in_front & visible).nonzero()[:, 0]

    footprints = _project(
        means[candidates], quats[candidates], log_scales[candidates], offset[candidates], camera, settings
    )
    bounded = footprints.finite()
    inside = _touches_image(footprints, opacities[candidates], camera, settings)
    culled = {
        "non_finite": int((~finite).sum() + (~bounded).sum()),
        "zero_quat": int((finite & ~has_direction).sum()),
        "behind": int((finite & has_direction & ~in_front).sum()),
        "faint": int((finite & has_direction & in_front & ~visible).sum()),
        "outside": int((bounded & ~inside).sum()),
    }
    return candidates[bounded & inside], culled


def _in_camera(means: Tensor, camera: Camera) -> Tensor:
    """Rw (x - centre): the difference comes first, to avoid cancellation far from the world's origin."""
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
    """EWA projection as a sheared footprint: no matrix inverse, and a determinant without a subtraction."""
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
    cross = torch.linalg.cross(m1, m2)
    h = settings.blur
    c = yy + h
    determinant = h * h + h * (xx + yy) + (cross * cross).sum(1)  # Lagrange's identity
    means2d = torch.stack([fx * rx + cx, fy * ry + cy], 1) + offset
    return _Footprints(means2d, xy / c, determinant / c, c, xx + h, z)


def _radii(footprints: _Footprints, opacities: Tensor, settings: RasterSettings) -> Tensor:
    """Half-widths [n, 2] in px of the box outside which alpha < alpha_min; compat: of the 3-sigma square."""
    if settings.compat:
        covariance = footprints.slope * footprints.c
        mean, half = 0.5 * (footprints.a + footprints.c), 0.5 * (footprints.a - footprints.c)
        largest = mean + torch.hypot(half, covariance)
        return (3 * largest.sqrt()).ceil()[:, None].expand(-1, 2)
    if settings.alpha_min == 0:
        return torch.full((len(opacities), 2), math.inf, dtype=torch.float64)
    level = 2 * (opacities / settings.alpha_min).log()
    return (level[:, None] * torch.stack([footprints.a, footprints.c], 1)).sqrt()


def _tile_range(footprints: _Footprints, radii: Tensor) -> tuple[Tensor, Tensor]:
    """compat: first and one-past-last tile that the square touches, as public rasterizers count them."""
    return ((footprints.means2d - radii) / TILE).floor(), ((footprints.means2d + radii) / TILE).ceil()


def _touches_image(footprints: _Footprints, opacities: Tensor, camera: Camera, settings: RasterSettings) -> Tensor:
    """Whether the footprint reaches a pixel centre, with a pixel of slack on each side."""
    radii = _radii(footprints, opacities, settings)
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    if settings.compat:
        first, last = _tile_range(footprints, radii)
        tiles = (size / TILE).ceil()
        return (first.clamp(min=0) < torch.minimum(last, tiles)).all(1)
    low, high = footprints.means2d - radii, footprints.means2d + radii
    return ((low <= size + 0.5) & (high >= -0.5)).all(1)


def _pixel_centres(camera: Camera) -> Tensor:
    columns = torch.arange(camera.width, dtype=torch.float64) + 0.5
    rows = torch.arange(camera.height, dtype=torch.float64) + 0.5
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).reshape(-1, 2)


def _composite(
    pixels: Tensor,
    footprints: _Footprints,
    opacities: Tensor,
    colors: Tensor,
    background: Tensor,
    settings: RasterSettings,
) -> Tensor:
    """Front to back over Gaussians in order, [pixel, 5]: colour, alpha, depth."""
    dx, dy = (pixels[:, None, :] - footprints.means2d).unbind(2)
    sheared = dx - footprints.slope * dy
    raw = opacities * torch.exp(-(sheared * sheared / (2 * footprints.v) + dy * dy / (2 * footprints.c)))
    counts = raw >= settings.alpha_min
    if settings.compat:
        first, last = _tile_range(footprints, _radii(footprints, opacities, settings))
        tile = (pixels / TILE).floor()[:, None, :]
        counts = counts & ((tile >= first) & (tile < last)).all(2)
    alpha = torch.where(counts, raw.clamp(max=settings.alpha_max), 0.0)
    ones = torch.ones(len(pixels), 1, dtype=torch.float64)
    with torch.no_grad():
        transmittance = torch.cat([ones, 1 - alpha], 1).cumprod(1)
        tested = transmittance[:, 1:] if settings.compat else transmittance[:, :-1]
        blended = tested >= settings.transmittance_min
    alpha = torch.where(blended, alpha, 0.0)
    transmittance = torch.cat([ones, 1 - alpha], 1).cumprod(1)
    weights, remaining = alpha * transmittance[:, :-1], transmittance[:, -1:]
    return torch.cat(
        [weights @ colors + remaining * background, 1 - remaining, weights @ footprints.depths[:, None]], 1
    )
