"""Arithmetic with the same bits on every machine.

Addition, multiplication, division and the square root are correctly rounded everywhere; sines of a C library, sums of
a BLAS and fused multiply-adds are not. Whatever decides a pixel is therefore computed with the functions below.
Vectors are [3, N] arrays, one row per coordinate, or triples of floats; angles are in turns (1 is a full circle).
"""

from __future__ import annotations

import hashlib
import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

TAU: Final = 6.283185307179586

# Taylor series of the sine up to y^15: 6e-12 off at a quarter turn, beyond which it is folded back.
_SERIES: Final = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(8))


def sine(turns: Any) -> Any:
    """Sine of an angle in turns: a float for a float, an array for an array."""
    if isinstance(turns, np.ndarray):
        rest = turns - np.floor(turns + 0.5)
        rest = np.where(rest > 0.25, 0.5 - rest, np.where(rest < -0.25, -0.5 - rest, rest))
    else:
        rest = turns - math.floor(turns + 0.5)
        rest = 0.5 - rest if rest > 0.25 else -0.5 - rest if rest < -0.25 else rest
    angle = rest * TAU
    square = angle * angle
    result = square * _SERIES[7] + _SERIES[6]
    for coefficient in reversed(_SERIES[:6]):
        result = result * square + coefficient
    return result * angle


def cosine(turns: Any) -> Any:
    """Cosine of an angle in turns."""
    return sine(turns + 0.25)


def dot(a: Any, b: Any) -> Any:
    """Inner product of vectors; where one is an array, for each of its columns."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def unit(a: Vector) -> Vector:
    """The direction of `a`."""
    length = math.sqrt(dot(a, a))
    return (a[0] / length, a[1] / length, a[2] / length)


def lengths(points: Array) -> Array:
    """Length [N] of each column of [3, N]."""
    return np.sqrt(dot(points, points))


def units(points: Array) -> Array:
    """Columns of [3, N] scaled to length 1."""
    return points / np.maximum(lengths(points), 1e-300)


def smooth(x: Any) -> Any:
    """3 x^2 - 2 x^3 of `x` clipped to [0, 1]."""
    x = np.clip(x, 0.0, 1.0) if isinstance(x, np.ndarray) else min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


def uniform(seed: int, name: str, count: int) -> Array:
    """`count` numbers in [0, 1) of the random stream `name`: a hash, so that no library version changes them."""
    words: list[int] = []
    for block in range((count + 3) // 4):
        digest = hashlib.sha256(f"{seed}/{name}/{block}".encode()).digest()
        words += [int.from_bytes(digest[8 * i : 8 * i + 8], "big") >> 11 for i in range(4)]
    return np.array([word * 2.0**-53 for word in words[:count]])
