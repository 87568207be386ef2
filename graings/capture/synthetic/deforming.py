"""Shapes that deform: a torus that closes to a sphere, and a sheet in the wind."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from graings.capture.synthetic.exact import TAU, Array, Vector, cosine, sine, smooth


@dataclass(frozen=True, slots=True)
class ClosingTorus:
    """A torus around z whose hole closes; at the end its radius is zero and it is a sphere.

    `radius` and `tube` are functions of time. A material point keeps its two angles; its coordinates are its place on
    the torus of radius 2 and tube 1. Inner points (angle beyond a quarter turn from the outer rim) end inside.
    """

    convex: ClassVar[bool] = False
    radius: Callable[[float], float]
    tube: Callable[[float], float]

    def bound(self, time: float) -> tuple[Vector, float]:
        """Around the outer rim."""
        return (0.0, 0.0, 0.0), self.radius(time) + self.tube(time)

    def box(self, time: float) -> tuple[Vector, Vector]:
        """The tightest."""
        across, up = self.radius(time) + self.tube(time), self.tube(time)
        return (-across, -across, -up), (across, across, up)

    def distance(self, points: Array, time: float) -> Array:
        """Exact outside."""
        across = np.sqrt(points[0] * points[0] + points[1] * points[1]) - self.radius(time)
        return np.sqrt(across * across + points[2] * points[2]) - self.tube(time)

    def material(self, points: Array, time: float) -> Array:
        """The same angles on the torus of radius 2 and tube 1."""
        across = np.maximum(np.sqrt(points[0] * points[0] + points[1] * points[1]), 1e-12)
        outward, up = across - self.radius(time), points[2]
        tube = np.maximum(np.sqrt(outward * outward + up * up), 1e-12)
        reach = 2.0 + outward / tube
        return np.stack([points[0] / across * reach, points[1] / across * reach, up / tube])

    def place(self, material: Array, time: float) -> Array:
        """The same angles on the torus of this time."""
        across = np.sqrt(material[0] * material[0] + material[1] * material[1])
        reach = self.radius(time) + self.tube(time) * (across - 2.0)
        return np.stack([material[0] / across * reach, material[1] / across * reach, self.tube(time) * material[2]])


@dataclass(frozen=True, slots=True)
class Flag:
    """A sheet in the x-z plane held at x = 0: waves run along x and grow with it, and the free end sways up and down.

    Material coordinates are those of the sheet at rest, [0, width] x [-thickness, thickness] x [0, height].
    """

    convex: ClassVar[bool] = False
    width: float
    height: float
    thickness: float
    amplitude: float
    waves: float  # along the width
    cycles: float  # from t = 0 to 1
    sway: float

    def bound(self, time: float) -> tuple[Vector, float]:
        """Around the box that the sheet can reach."""
        x, y, z = 0.5 * self.width, self.amplitude * 1.25 + self.thickness, 0.5 * self.height + self.sway
        return (x, 0.0, 0.5 * self.height), math.sqrt(x * x + y * y + z * z)

    def box(self, time: float) -> tuple[Vector, Vector]:
        """The box that the sheet can reach."""
        y = self.amplitude * 1.25 + self.thickness
        return (0.0, -y, -self.sway), (self.width, y, self.height + self.sway)

    def _lift(self, x: Array, time: float) -> Array:
        """Displacement [N] along z."""
        part = x / self.width
        return self.sway * part * part * sine(1.5 * time + 0.1)

    def _wave(self, x: Array, z: Array, time: float) -> Array:
        """Displacement [N] along y; `z` is that at rest."""
        part = x / self.width
        phase = self.waves * part - self.cycles * time + 0.12 * z / self.height
        growth = smooth(0.1 + 0.75 * part) * np.clip(part * 6.0, 0.0, 1.0)
        return self.amplitude * growth * (sine(phase) + 0.25 * sine(1.7 * phase + 0.4 * z / self.height))

    @property
    def steepness(self) -> float:
        """A bound on the slope of the wave."""
        per_x = self.amplitude / self.width * (TAU * self.waves * (1.0 + 0.25 * 1.7) + 1.25 * 2.4)
        return per_x + self.amplitude * 1.25 * 0.5 * TAU / self.height * 0.3

    def distance(self, points: Array, time: float) -> Array:
        """A lower bound: the distance to the sheet along y over its largest stretch."""
        x = np.clip(points[0], 0.0, self.width)
        z = points[2] - self._lift(x, time)
        inside = np.clip(z, 0.0, self.height)
        off = np.abs(points[1] - self._wave(x, inside, time)) - self.thickness
        beside = np.maximum(np.abs(points[0] - 0.5 * self.width) - 0.5 * self.width, 0.0)
        above = np.maximum(np.abs(z - 0.5 * self.height) - 0.5 * self.height, 0.0)
        edge = np.sqrt(beside * beside + above * above)
        positive = np.maximum(off, 0.0)
        outside = np.sqrt(positive * positive + edge * edge)
        # Inside the slab beyond an edge only the edge counts; within the outline only the slab.
        return np.where(edge > 0.0, outside, off) / math.sqrt(1.0 + self.steepness * self.steepness)

    def material(self, points: Array, time: float) -> Array:
        """The sheet at rest."""
        x = np.clip(points[0], 0.0, self.width)
        z = np.clip(points[2] - self._lift(x, time), 0.0, self.height)
        return np.stack([x, points[1] - self._wave(x, z, time), z])

    def place(self, material: Array, time: float) -> Array:
        """The sheet at `time`."""
        x, y, z = material
        return np.stack([x, y + self._wave(x, z, time), z + self._lift(x, time)])


CLOSED: Final = 0.85  # share of the time after which the torus is a sphere


def closing_radius(time: float) -> float:
    """Radius of the torus: 0.66 at first, 0 from `CLOSED` on."""
    return 0.66 * (1.0 - float(smooth(time / CLOSED)))


def closing_tube(time: float) -> float:
    """Tube that keeps the whole about as large: 0.26 at first, 0.72 as a sphere."""
    return 0.26 + 0.46 * float(smooth(time / CLOSED)) + 0.04 * float(cosine(2.0 * time) - 1.0)
