"""Encodings: frequencies of positions and times (gamma of Eq. 7 and 12), spherical harmonics of directions.

The compiled kernel computes values, and gradients with respect to the normals of reflected directions. Gradients with
respect to positions and directions are needed in ablations and tests only and are left to torch: the stop-gradient of
Eq. 7 makes positions constants.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor
from torch.autograd.function import once_differentiable

from graings import constants, kernel

# Added to a normal's squared length, here and in the kernel: for a length below 1e-3 the reflection fades out, because
# the direction of so short a normal is noise.
_NORMAL_EPSILON = 1e-6


def encoding_width(dimensions: int, octaves: int) -> int:
    """Length of the encoding of a `dimensions`-vector."""
    return dimensions * (1 + 2 * octaves)


def frequency_encoding(x: Float[Tensor, "*batch dim"], octaves: int) -> Float[Tensor, "*batch width"]:
    """(x, sin 2^0 x, ..., sin 2^(L-1) x, cos 2^0 x, ..., cos 2^(L-1) x) with L = `octaves`.

    The raw value is included and the frequencies have no factor pi, so that over [0, 1] the lowest octave is monotone
    and t = 0 and t = 1 have different encodings. Differentiable where `x` requires a gradient.
    """
    if octaves == 0:
        return x
    if x.requires_grad and torch.is_grad_enabled():
        return plain_frequency_encoding(x, octaves)
    encoded = x.new_empty(*x.shape[:-1], encoding_width(x.shape[-1], octaves))
    kernel.call("encode", x.detach().contiguous(), x.shape[-1], octaves, encoded, kernel.thread_count())
    return encoded


def plain_frequency_encoding(x: Float[Tensor, "*batch dim"], octaves: int) -> Float[Tensor, "*batch width"]:
    """The oracle of `frequency_encoding`, which also calls it where `x` requires a gradient."""
    frequencies = 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)
    phases = (x.unsqueeze(-1) * frequencies).flatten(-2)
    return torch.cat([x, phases.sin(), phases.cos()], dim=-1)


def reflected(directions: Float[Tensor, "*batch 3"], normals: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Unit `directions` reflected at planes with `normals` of any length; a normal of zero reflects nothing.

    This is Eq. 4 of Ref-NeRF for directions that point from the camera to the surface.
    """
    squared = normals.square().sum(dim=-1, keepdim=True) + _NORMAL_EPSILON
    return directions - 2 * ((directions * normals).sum(dim=-1, keepdim=True) / squared) * normals


def directions_from(eye: ArrayLike, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Unit vectors from `eye` [3] to `positions`, which get no gradient; shorter within `constants.NEAR` of the eye."""
    directions = torch.empty_like(positions)
    at = np.asarray(eye, dtype=np.float64).ravel()
    kernel.call("directions", positions.detach().contiguous(), at, constants.NEAR, directions, kernel.thread_count())
    return directions


def direction_width(degree: int) -> int:
    """Length of the encoding of a direction: the real spherical harmonics of degrees 1 to `degree`."""
    return degree * (degree + 2)


def direction_encoding(
    directions: Float[Tensor, "*batch 3"], degree: int, normals: Float[Tensor, "*batch 3"] | None = None
) -> Float[Tensor, "*batch width"]:
    """Real spherical harmonics of degrees 1 to `degree` (at most 3) of unit vectors; degree 0 is left to a bias.

    They are scaled so that those of degree 1 are the direction itself: each has the mean square 1/3 over all
    directions. With `normals`, those of the directions `reflected` at them follow, which doubles the width.
    Differentiable where either input requires a gradient.
    """
    if directions.requires_grad and torch.is_grad_enabled():
        return plain_direction_encoding(directions, degree, normals)
    encoded: Tensor = _DirectionEncoding.apply(directions, normals, degree, kernel.thread_count())  # type: ignore[no-untyped-call]
    return encoded


def plain_direction_encoding(
    directions: Float[Tensor, "*batch 3"], degree: int, normals: Float[Tensor, "*batch 3"] | None = None
) -> Float[Tensor, "*batch width"]:
    """The oracle of `direction_encoding`, which also calls it where `directions` require a gradient."""
    encoded = _spherical_harmonics(directions, degree)
    if normals is None:
        return encoded
    return torch.cat([encoded, _spherical_harmonics(reflected(directions, normals), degree)], dim=-1)


def _spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    x, y, z = directions.unbind(-1)
    harmonics = [x, y, z]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        a = math.sqrt(5)
        harmonics += [a * x * y, a * y * z, a / math.sqrt(12) * (3 * zz - 1), a * x * z, a / 2 * (xx - yy)]
    if degree >= 3:
        b, c, d = math.sqrt(35 / 24), math.sqrt(35), math.sqrt(7 / 8)
        harmonics += [
            b * y * (3 * xx - yy),
            c * x * y * z,
            d * y * (5 * zz - 1),
            math.sqrt(7 / 12) * z * (5 * zz - 3),
            d * x * (5 * zz - 1),
            c / 2 * z * (xx - yy),
            b * x * (xx - 3 * yy),
        ]
    return torch.stack(harmonics, dim=-1)


class _DirectionEncoding(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, directions: Tensor, normals: Tensor | None, degree: int, threads: int) -> Tensor:
        directions = directions.detach().contiguous()
        normals = None if normals is None else normals.detach().contiguous()
        width = direction_width(degree) * (1 if normals is None else 2)
        encoded = directions.new_empty(*directions.shape[:-1], width)
        kernel.call("encode_directions", directions, normals, degree, encoded, threads)
        ctx.save_for_backward(directions, normals)
        ctx.constants = (degree, threads)
        return encoded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        directions, normals = ctx.saved_tensors
        degree, threads = ctx.constants
        v_normals = torch.empty_like(normals)
        kernel.call(
            "encode_directions_gradient", directions, normals, degree, upstream.contiguous(), v_normals, threads
        )
        return None, v_normals, None, None
