"""Shapes as signed distance functions in body coordinates: negative inside, zero on the surface.

A distance may be too small but never larger than the true one, so that a ray that advances by it cannot pass through a
surface. The formulas are those of Inigo Quilez' collection of distance functions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from graings.capture.synthetic.exact import Array, Vector, dot, lengths


class Shape(Protocol):
    """What the ray caster needs of a shape; points are [3, N] in body coordinates."""

    convex: ClassVar[bool]  # casts no shadow on itself

    def bound(self, time: float) -> tuple[Vector, float]:
        """Centre and radius of a sphere around the shape."""
        ...

    def box(self, time: float) -> tuple[Vector, Vector]:
        """Lowest and highest corner of an upright box around the shape."""
        ...

    def distance(self, points: Array, time: float) -> Array:
        """Signed distance [N]."""
        ...

    def material(self, points: Array, time: float) -> Array:
        """Coordinates [3, N] that stay with the material of surface points; textures are functions of them."""
        ...

    def place(self, material: Array, time: float) -> Array:
        """Inverse of `material` on the surface."""
        ...


def _mirrored(x: float, y: float, z: float) -> tuple[Vector, Vector]:
    return (-x, -y, -z), (x, y, z)


class Rigid:
    """A shape whose material coordinates are the body coordinates."""

    __slots__ = ()
    convex: ClassVar[bool] = True

    def material(self, points: Array, time: float) -> Array:
        """The points themselves."""
        return points

    def place(self, material: Array, time: float) -> Array:
        """The coordinates themselves."""
        return material


@dataclass(frozen=True, slots=True)
class Ball(Rigid):
    """A sphere around the origin."""

    radius: float

    def bound(self, time: float) -> tuple[Vector, float]:
        """The sphere itself."""
        return (0.0, 0.0, 0.0), self.radius

    def box(self, time: float) -> tuple[Vector, Vector]:
        """The tightest."""
        return _mirrored(self.radius, self.radius, self.radius)

    def distance(self, points: Array, time: float) -> Array:
        """Exact."""
        return lengths(points) - self.radius


@dataclass(frozen=True, slots=True)
class RoundCone(Rigid):
    """The hull of a sphere of radius `start` at the origin and one of radius `end` at height `height` on the z axis."""

    height: float
    start: float
    end: float

    def bound(self, time: float) -> tuple[Vector, float]:
        """The smallest sphere around both."""
        radius = 0.5 * (self.height + self.start + self.end)
        return (0.0, 0.0, 0.5 * (self.height + self.end - self.start)), radius

    def box(self, time: float) -> tuple[Vector, Vector]:
        """The tightest."""
        w = max(self.start, self.end)
        return (-w, -w, -self.start), (w, w, self.height + self.end)

    def distance(self, points: Array, time: float) -> Array:
        """Exact."""
        slope = (self.start - self.end) / self.height
        rise = math.sqrt(1.0 - slope * slope)
        across = np.sqrt(points[0] * points[0] + points[1] * points[1])
        z = points[2]
        place = z * rise - across * slope
        to_start = np.sqrt(across * across + z * z) - self.start
        above = z - self.height
        to_end = np.sqrt(across * across + above * above) - self.end
        between = across * rise + z * slope - self.start
        return np.where(place < 0.0, to_start, np.where(place > rise * self.height, to_end, between))


@dataclass(frozen=True, slots=True)
class Box(Rigid):
    """A box with half-sizes `half` (rounding included) and edges rounded with radius `rounding`."""

    half: Vector
    rounding: float = 0.02

    def bound(self, time: float) -> tuple[Vector, float]:
        """Through the corners."""
        return (0.0, 0.0, 0.0), math.sqrt(dot(self.half, self.half))

    def box(self, time: float) -> tuple[Vector, Vector]:
        """The tightest."""
        return _mirrored(*self.half)

    def distance(self, points: Array, time: float) -> Array:
        """Exact."""
        excess = np.abs(points) - (np.array(self.half)[:, None] - self.rounding)
        outside = lengths(np.maximum(excess, 0.0))
        inside = np.minimum(np.maximum(np.maximum(excess[0], excess[1]), excess[2]), 0.0)
        return outside + inside - self.rounding


@dataclass(frozen=True, slots=True)
class Disc(Rigid):
    """An upright cylinder of half-height `half` with rounded edges; its axis is z."""

    radius: float
    half: float
    rounding: float = 0.02

    def bound(self, time: float) -> tuple[Vector, float]:
        """Through the rims."""
        return (0.0, 0.0, 0.0), math.sqrt(self.radius * self.radius + self.half * self.half)

    def box(self, time: float) -> tuple[Vector, Vector]:
        """The tightest."""
        return _mirrored(self.radius, self.radius, self.half)

    def distance(self, points: Array, time: float) -> Array:
        """Exact."""
        across = np.sqrt(points[0] * points[0] + points[1] * points[1]) - (self.radius - self.rounding)
        above = np.abs(points[2]) - (self.half - self.rounding)
        outside_across, outside_above = np.maximum(across, 0.0), np.maximum(above, 0.0)
        outside = np.sqrt(outside_across * outside_across + outside_above * outside_above)
        return outside + np.minimum(np.maximum(across, above), 0.0) - self.rounding


@dataclass(frozen=True, slots=True)
class Hoop(Rigid):
    """A torus around the z axis with radius `radius` and tube `tube`."""

    convex: ClassVar[bool] = False
    radius: float
    tube: float

    def bound(self, time: float) -> tuple[Vector, float]:
        """Around the outer rim."""
        return (0.0, 0.0, 0.0), self.radius + self.tube

    def box(self, time: float) -> tuple[Vector, Vector]:
        """The tightest."""
        return _mirrored(self.radius + self.tube, self.radius + self.tube, self.tube)

    def distance(self, points: Array, time: float) -> Array:
        """Exact."""
        across = np.sqrt(points[0] * points[0] + points[1] * points[1]) - self.radius
        return np.sqrt(across * across + points[2] * points[2]) - self.tube


@dataclass(frozen=True, slots=True)
class Spokes(Rigid):
    """2^(folds + 1) rods of radius `tube` in the x-y plane, from `inner` to `outer` off the z axis.

    Mirror planes map every rod to the same one, so that all cost as much as one.
    """

    convex: ClassVar[bool] = False
    inner: float
    outer: float
    tube: float
    folds: int

    def bound(self, time: float) -> tuple[Vector, float]:
        """Around all rods."""
        return (0.0, 0.0, 0.0), self.outer + self.tube

    def box(self, time: float) -> tuple[Vector, Vector]:
        """The tightest."""
        return _mirrored(self.outer + self.tube, self.outer + self.tube, self.tube)

    def distance(self, points: Array, time: float) -> Array:
        """Exact: each fold maps a point to the side of its nearest rod."""
        x, y = np.abs(points[0]), np.abs(points[1])  # two mirror planes: rods along both axes are four
        c, s = 0.0, 1.0  # of the quarter turn
        for _ in range(self.folds):
            # Mirror at half of the present wedge, whose upper edge is at the angle with cosine c and sine s.
            c, s = math.sqrt(0.5 * (1.0 + c)), math.sqrt(0.5 * (1.0 - c))
            over = np.maximum(y * c - x * s, 0.0)
            x, y = x + 2.0 * over * s, y - 2.0 * over * c
        along = np.clip(x, self.inner, self.outer)
        dx = x - along
        return np.sqrt(dx * dx + y * y + points[2] * points[2]) - self.tube


@dataclass(frozen=True, slots=True)
class Room(Rigid):
    """The inside of a box: its walls seen from within. Drawn in closed form, casts no shadow."""

    half: Vector

    def bound(self, time: float) -> tuple[Vector, float]:
        """Through the corners."""
        return (0.0, 0.0, 0.0), math.sqrt(dot(self.half, self.half))

    def box(self, time: float) -> tuple[Vector, Vector]:
        """The tightest."""
        return _mirrored(*self.half)

    def distance(self, points: Array, time: float) -> Array:
        """To the nearest wall, for points inside."""
        rest = np.array(self.half)[:, None] - np.abs(points)
        return np.minimum(np.minimum(rest[0], rest[1]), rest[2])

    def exit(self, origin: Array, directions: Array) -> Array:
        """Distance [N] along rays from inside until a wall; `origin` is [3, 1] or [3, N]."""
        steps = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        reach = (np.where(steps > 0, 1.0, -1.0) * np.array(self.half)[:, None] - origin) / steps
        return np.minimum(np.minimum(reach[0], reach[1]), reach[2])
