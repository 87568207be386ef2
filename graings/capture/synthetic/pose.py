"""Pose: where a body is and how it is turned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from graings.capture.synthetic.exact import Array, Vector, cosine, cross, dot, sine, unit


@dataclass(frozen=True, slots=True)
class Pose:
    """World position of a point q of the body: rows * q + origin, with orthonormal `rows`."""

    rows: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    origin: Vector = (0.0, 0.0, 0.0)

    def turned(self, axis: Literal["x", "y", "z"], turns: float) -> Pose:
        """This pose after a rotation about one of the body's own axes."""
        c, s = cosine(turns), sine(turns)
        rotation = {
            "x": ((1.0, 0.0, 0.0), (0.0, c, -s), (0.0, s, c)),
            "y": ((c, 0.0, s), (0.0, 1.0, 0.0), (-s, 0.0, c)),
            "z": ((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)),
        }[axis]
        a, b, c_ = ((rotation[0][i], rotation[1][i], rotation[2][i]) for i in range(3))
        return Pose(tuple((dot(row, a), dot(row, b), dot(row, c_)) for row in self.rows), self.origin)  # type: ignore[arg-type]

    def moved(self, x: float, y: float, z: float) -> Pose:
        """This pose after a translation along the body's own axes."""
        a, b, c = (dot(row, (x, y, z)) + at for row, at in zip(self.rows, self.origin, strict=True))
        return Pose(self.rows, (a, b, c))

    def to_world(self, points: Array) -> Array:
        """World positions [3, N] of body points [3, N]."""
        return self.rotate(points) + np.array(self.origin)[:, None]

    def to_body(self, points: Array) -> Array:
        """Body points [3, N] at world positions [3, N]."""
        return self.rotate_back(points - np.array(self.origin)[:, None])

    def rotate(self, directions: Array) -> Array:
        """World directions [3, N] of body directions."""
        return np.stack([dot(row, directions) for row in self.rows])

    def rotate_back(self, directions: Array) -> Array:
        """Body directions [3, N] of world directions."""
        columns = [(self.rows[0][i], self.rows[1][i], self.rows[2][i]) for i in range(3)]
        return np.stack([dot(column, directions) for column in columns])


STILL: Final = Pose()


def at(x: float, y: float, z: float) -> Pose:
    """A pose that is only a translation."""
    return Pose(origin=(x, y, z))


def along(start: Vector, end: Vector) -> tuple[Pose, float]:
    """The pose at `start` whose z axis points to `end`, and how far that is."""
    delta = (end[0] - start[0], end[1] - start[1], end[2] - start[2])
    z = unit(delta)
    x = unit(cross((0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (1.0, 0.0, 0.0), z))
    y = cross(z, x)
    rows = ((x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2]))
    return Pose(rows, start), dot(delta, z)
