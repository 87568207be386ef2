"""Textures: linear colours as functions of material coordinates.

Transitions are smooth over a share of the period, so that images of a few hundred pixels sample them without aliasing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from graings.capture.synthetic.exact import Array, Vector, dot, lengths, sine, uniform

Texture = Callable[[Array], Array]  # [3, N] material coordinates to [3, N] linear colours


def rgb(code: str) -> Vector:
    """Linear colour of a code such as "e0a030"; images store the square root of linear values."""
    r, g, b = (int(code[i : i + 2], 16) / 255.0 for i in (0, 2, 4))
    return (r * r, g * g, b * b)


def mixed(share: Array, low: Vector, high: Vector) -> Array:
    """From `low` at share 0 to `high` at 1."""
    return np.stack([a + (b - a) * share for a, b in zip(low, high, strict=True)])


def _step(wave: Array, sharpness: float) -> Array:
    return 0.5 + 0.5 * np.clip(wave * sharpness, -1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Plain:
    """One colour."""

    color: Vector

    def __call__(self, points: Array) -> Array:
        """The colour everywhere."""
        return np.repeat(np.array(self.color)[:, None], points.shape[1], axis=1)


@dataclass(frozen=True, slots=True)
class Stripes:
    """Stripes across `axis` with a period in its units."""

    low: Vector
    high: Vector
    axis: Vector
    period: float
    phase: float = 0.0
    sharpness: float = 4.0

    def __call__(self, points: Array) -> Array:
        """Colours of the points."""
        return mixed(
            _step(sine(dot(self.axis, points) / self.period + self.phase), self.sharpness), self.low, self.high
        )


@dataclass(frozen=True, slots=True)
class Checker:
    """A chequerboard over two axes, the same along the third."""

    low: Vector
    high: Vector
    axes: tuple[int, int]
    period: float
    sharpness: float = 6.0

    def __call__(self, points: Array) -> Array:
        """Colours of the points."""
        a, b = (sine(points[axis] / self.period + 0.125) for axis in self.axes)
        return mixed(_step(a * b, self.sharpness), self.low, self.high)


@dataclass(frozen=True, slots=True)
class Lattice:
    """A solid pattern of cells in all three directions."""

    low: Vector
    high: Vector
    period: float
    sharpness: float = 3.0

    def __call__(self, points: Array) -> Array:
        """Colours of the points."""
        x, y, z = (sine(points[axis] / self.period + 0.1) for axis in range(3))
        return mixed(_step(x * y + y * z + z * x, self.sharpness), self.low, self.high)


@dataclass(frozen=True, slots=True)
class Marble:
    """Bands between colours of `palette` along a sum of waves in random directions."""

    palette: tuple[Vector, ...]
    scale: float
    seed: int
    sharpness: float = 1.0

    def __call__(self, points: Array) -> Array:
        """Colours of the points."""
        numbers = uniform(self.seed, "marble", 20).tolist()
        total = np.zeros(points.shape[1])
        for k in range(5):
            a, b, c, phase = numbers[4 * k : 4 * k + 4]
            axis = (2.0 * a - 1.0, 2.0 * b - 1.0, 2.0 * c - 1.0)
            total = total + sine(dot(axis, points) / self.scale + phase + 0.15 * total)
        level = np.clip(0.5 + 0.2 * self.sharpness * total, 0.0, 1.0) * (len(self.palette) - 1)
        result = mixed(np.clip(level, 0.0, 1.0), self.palette[0], self.palette[1])
        for k in range(1, len(self.palette) - 1):
            result = result + (np.array(self.palette[k + 1]) - np.array(self.palette[k]))[:, None] * np.clip(
                level - k, 0.0, 1.0
            )
        return result


@dataclass(frozen=True, slots=True)
class Globe:
    """A map of land, sea and ice with a grid of meridians and parallels, on a sphere around the origin."""

    seed: int

    def __call__(self, points: Array) -> Array:
        """Colours of the points, which lie around the origin."""
        direction = points / np.maximum(lengths(points), 1e-12)
        land = Marble((rgb("1d4f8c"), rgb("2b6cb0"), rgb("e8d8a0"), rgb("4f9a4a"), rgb("8a6b3d")), 0.62, self.seed, 1.5)
        colors = land(direction)
        ice = np.clip((np.abs(direction[2]) - 0.86) * 12.0, 0.0, 1.0)
        colors = colors + (np.array(rgb("f4f8ff"))[:, None] - colors) * ice
        across = np.maximum(np.sqrt(1.0 - np.minimum(direction[2] * direction[2], 1.0 - 1e-9)), 1e-4)
        c, s = direction[0] / across, direction[1] / across
        for _ in range(2):  # the angle four times over
            c, s = c * c - s * s, 2.0 * c * s
        c, s = c * (c * c - 3.0 * s * s), s * (3.0 * c * c - s * s)  # and that three times
        meridian = np.clip(1.4 - np.abs(s) * across * 5.0, 0.0, 1.0) * np.clip(
            (0.97 - np.abs(direction[2])) * 20.0, 0.0, 1.0
        )
        parallel = np.clip(1.4 - np.abs(sine(direction[2] * 2.5)) * 5.0, 0.0, 1.0)
        line = 0.75 * np.maximum(meridian, parallel)
        return colors + (np.array(rgb("fff6d8"))[:, None] - colors) * line


@dataclass(frozen=True, slots=True)
class ByNormal:
    """Walls of a room: another texture for the floor, the ceiling and the two pairs of walls."""

    half: Vector
    floor: Texture
    ceiling: Texture
    sides: Texture  # at x = +-half
    ends: Texture  # at y = +-half

    def __call__(self, points: Array) -> Array:
        """Colours of points on the inside of the box."""
        rest = [self.half[axis] - np.abs(points[axis]) for axis in range(3)]
        nearest = np.argmin(np.stack(rest), axis=0)
        level = np.where(nearest == 2, np.where(points[2] < 0.0, 2, 3), nearest)
        colors = np.empty_like(points)
        for number, texture in enumerate((self.sides, self.ends, self.floor, self.ceiling)):
            chosen = np.flatnonzero(level == number)
            if len(chosen):
                colors[:, chosen] = texture(points[:, chosen])
        return colors


@dataclass(frozen=True, slots=True)
class Layered:
    """`top` where the material coordinate along `axis` exceeds `edge`, else `base`; a soft seam of width `seam`."""

    base: Texture
    top: Texture
    axis: int
    edge: float
    seam: float = 0.02

    def __call__(self, points: Array) -> Array:
        """Colours of the points."""
        share = np.clip((points[self.axis] - self.edge) / self.seam + 0.5, 0.0, 1.0)
        low = self.base(points)
        return low + (self.top(points) - low) * share
