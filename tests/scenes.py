"""Small Gaussian scenes, ordinary and extreme, generated from a seed.

Every builder returns float64 Gaussians and a camera that looks at them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from graings.camera.camera import Camera
from graings.constants import NEAR
from graings.gaussians import Gaussians

Scene = tuple[Gaussians, Camera]
FLOATS = ("means", "quats", "log_scales", "opacities", "colors")


def cast(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    """The same Gaussians in another precision."""
    return replace(gaussians, **{name: getattr(gaussians, name).to(dtype) for name in FLOATS})


def rows(gaussians: Gaussians, index: Tensor) -> Gaussians:
    """A selection or permutation of the Gaussians, uids carried along."""
    return replace(gaussians, **{name: getattr(gaussians, name)[index] for name in (*FLOATS, "uids")})


def pinhole(
    width: int = 48, height: int = 32, *, focal: float = 40.0, cx: float | None = None, cy: float | None = None
) -> Camera:
    """A camera at the origin that looks along +z."""
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    return Camera(np.eye(4), focal, focal, cx, cy, width, height)


def gaussians(
    count: int,
    seed: int,
    *,
    spread: float = 0.5,
    depth: tuple[float, float] = (2.0, 4.0),
    log_scales: tuple[float, float] = (-3.0, -1.0),
    opacity: tuple[float, float] = (0.05, 1.1),
) -> Gaussians:
    """Random Gaussians in front of `pinhole`; x and y spread per unit of depth, log-scales and opacities uniform."""
    random = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *size: int) -> Tensor:
        return low + (high - low) * torch.rand(*size, generator=random, dtype=torch.float64)

    z = uniform(*depth, count, 1)
    return Gaussians(
        means=torch.cat([uniform(-spread, spread, count, 2) * z, z], 1),
        quats=torch.randn(count, 4, generator=random, dtype=torch.float64),
        log_scales=uniform(*log_scales, count, 3),
        opacities=uniform(*opacity, count),
        colors=uniform(0, 1, count, 3),
        uids=torch.randperm(count, generator=random),
    )


def overlapping(seed: int = 0) -> Scene:
    return gaussians(60, seed, log_scales=(-2.5, -0.5)), pinhole()


def needles(seed: int = 1) -> Scene:
    scene = gaussians(40, seed, spread=0.08, depth=(3.0, 5.0))
    scales = torch.tensor([1.0, 1e-6, 1e-6], dtype=torch.float64).log().expand(40, 3)
    return replace(scene, log_scales=scales.clone()), pinhole(focal=300.0)


def near_plane(seed: int = 2) -> Scene:
    depth, scales = (NEAR * (1 + 1e-6), 1.2 * NEAR), (math.log(0.01), math.log(10.0))
    return gaussians(30, seed, spread=0.05, depth=depth, log_scales=scales, opacity=(0.02, 0.3)), pinhole(focal=500.0)


def wide(seed: int = 3) -> Scene:
    """Most means lie outside 1.3 of the half field of view, where x/z is clamped; elongated footprints reach in."""
    scene = gaussians(60, seed, spread=6.0, depth=(0.5, 3.0), log_scales=(-2.0, 1.2))
    return scene, pinhole(focal=8.0)


def off_centre(seed: int = 4) -> Scene:
    scene = gaussians(50, seed, spread=1.0, log_scales=(-2.0, 0.0))
    return scene, pinhole(focal=30.0, cx=-20.0, cy=50.0)


def telephoto(seed: int = 5) -> Scene:
    """f = 1e5 px at a distance of 1000, turned, and the world 4e3 away from its origin."""
    camera = Camera.look_at((4600.0, 4800.0, 4000.0), (4000.0, 4000.0, 4000.0), fov=0.1, width=48, height=32)
    camera = Camera(camera.world_to_camera, 1e5, 1e5, 24.0, 16.0, 48, 32)
    scene = gaussians(40, seed, log_scales=(-6.0, -3.5))
    away = torch.randn(40, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 0.1
    return replace(scene, means=4000.0 + away), camera


def discs(seed: int = 6) -> Scene:
    scene = gaussians(30, seed, log_scales=(-1.0, -0.5))
    scales = scene.log_scales.clone()
    scales[:, 2] = -80.0
    return replace(scene, log_scales=scales), pinhole()


def scale_ratio(seed: int = 7) -> Scene:
    return gaussians(60, seed, log_scales=(math.log(1e-6), 0.0)), pinhole()


def far_from_origin(seed: int = 8) -> Scene:
    scene, offset = gaussians(40, seed), torch.tensor([1e5, -1e5, 1e5], dtype=torch.float64)
    pose = np.eye(4)
    pose[:3, 3] = -offset.numpy()
    camera = pinhole()
    return replace(scene, means=scene.means + offset), Camera(pose, 40.0, 40.0, 24.0, 16.0, camera.width, camera.height)


def deep_stack(seed: int = 9) -> Scene:
    """500 faint Gaussians behind one another: the stop rule and the rounding of long sums."""
    return gaussians(500, seed, spread=0.1, log_scales=(-1.0, 0.0), opacity=(0.004, 0.06)), pinhole(24, 20)


def opaque(seed: int = 10) -> Scene:
    """Nearly every centre is above the alpha cap."""
    return gaussians(40, seed, log_scales=(-1.5, -0.5), opacity=(0.95, 1.1)), pinhole()


SCENES: dict[str, Callable[[], Scene]] = {
    build.__name__: build
    for build in (
        overlapping, needles, near_plane, wide, off_centre, telephoto, discs, scale_ratio, far_from_origin, deep_stack,
        opaque,
    )
}  # fmt: skip
