"""Checks of a rasterizer's arguments beyond those of `Gaussians` and `Camera`.

Shared by the kernel's Python side and the slow reference, so that both refuse the same calls with the same messages.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from graings.gaussians import Gaussians


def check_arguments(
    gaussians: Gaussians,
    background: Float[Tensor, " 3"],
    means2d_offset: Float[Tensor, "gaussian 2"] | None,
    threads: int | None,
) -> None:
    """Raise `ValueError` naming the argument, the expected value and the given one."""
    dtype = gaussians.means.dtype
    _check("background", background, (3,), dtype)
    if means2d_offset is not None:
        _check("means2d_offset", means2d_offset, (len(gaussians), 2), dtype)
    if threads is not None and threads < 1:
        raise ValueError(f"threads must be at least 1, got {threads}")
    for name in ("means", "quats", "log_scales", "opacities", "colors", "uids"):
        tensor = getattr(gaussians, name)
        if not tensor.is_cpu:
            raise ValueError(f"{name} must be on the CPU, got {tensor.device}")


def _check(name: str, tensor: Tensor, shape: tuple[int, ...], dtype: object) -> None:
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
    if tensor.dtype != dtype:
        raise ValueError(f"{name} must be {dtype} like the Gaussians, got {tensor.dtype}")
    if not tensor.is_cpu:
        raise ValueError(f"{name} must be on the CPU, got {tensor.device}")
