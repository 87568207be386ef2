"""World: the parts of a synthetic scene, its light and its cameras, as functions of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from graings.capture.synthetic.exact import Array, Vector, unit
from graings.capture.synthetic.pose import STILL, Pose
from graings.capture.synthetic.shapes import Shape
from graings.capture.synthetic.textures import Texture

_SLANTING: Final = unit((0.45, -0.35, 0.82))


@dataclass(frozen=True, slots=True)
class Light:
    """A distant light and what comes from all around; linear colours."""

    direction: Vector = _SLANTING  # towards the light
    color: Vector = (0.92, 0.86, 0.76)
    sky: Vector = (0.34, 0.38, 0.46)  # ambient light on a surface that faces up
    ground: Vector = (0.20, 0.17, 0.15)  # and on one that faces down
    softness: float = 0.07  # half-width of the penumbra per unit of distance from the caster


def never_moves(time: float) -> Pose:
    """The pose of what rests."""
    return STILL


@dataclass(frozen=True, slots=True)
class Part:
    """A body: a shape, where it is at each time, and what it looks like."""

    shape: Shape
    texture: Texture
    pose: Callable[[float], Pose] = never_moves
    moves: bool = False
    gloss: float = 0.0  # strength of the highlight
    sharpness: int = 5  # its exponent is 2 to this power
    mirror: float = 0.0  # share of the light that is reflected as by a mirror


@dataclass(frozen=True, slots=True)
class CameraPath:
    """Where the cameras are: on a sphere around `target`, within ranges of azimuth and elevation (turns)."""

    distance: float = 4.0
    azimuth: tuple[float, float] = (0.0, 1.0)
    elevation: tuple[float, float] = (0.03, 0.16)
    target: Vector = (0.0, 0.0, 0.0)
    focal: float = 1.3914  # in image widths; a field of view of 0.69 radians, as in the D-NeRF scenes
    box: Vector | None = None  # positions are moved into this half-size around the origin: the inside of a room


def constant_light(time: float) -> Light:
    """The default light."""
    return Light()


def full_exposure(time: float) -> float:
    """Exposure 1."""
    return 1.0


CameraSetup = Literal["moving", "rig", "still"]


@dataclass(frozen=True, slots=True)
class World:
    """Everything that is drawn. `room` scenes are opaque; the others have straight alpha.

    `cameras`: one moving camera, fixed cameras that each see all instants, or a single instant.
    """

    parts: tuple[Part, ...]
    path: CameraPath = field(default_factory=CameraPath)
    light: Callable[[float], Light] = constant_light
    exposure: Callable[[float], float] = full_exposure
    room: bool = False
    cameras: CameraSetup = "moving"

    def at(self, time: float) -> Instant:
        """The world at one time."""
        return Instant(tuple(_placed(part, time) for part in self.parts), self.light(time), self.exposure(time))


@dataclass(frozen=True, slots=True)
class Placed:
    """A part at one time. Points and directions are [3, N] in the world."""

    part: Part
    time: float
    pose: Pose
    center: Vector  # of the bounding sphere
    radius: float

    def distance(self, points: Array) -> Array:
        """Signed distance [N]."""
        return self.part.shape.distance(self.pose.to_body(points), self.time)

    def normals(self, points: Array) -> Array:
        """Outward unit normals [3, N] at surface points, by differences of the distance along four directions."""
        body = self.pose.to_body(points)
        total = np.zeros_like(body)
        for corner in ((1.0, -1.0, -1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, 1.0, 1.0)):
            offset = np.array(corner)[:, None]
            total = total + offset * self.part.shape.distance(body + _STEP * offset, self.time)
        square = total[0] * total[0] + total[1] * total[1] + total[2] * total[2]
        return self.pose.rotate(total / np.maximum(np.sqrt(square), 1e-300))

    def colors(self, points: Array) -> Array:
        """Linear albedo [3, N] of surface points."""
        return self.part.texture(self.part.shape.material(self.pose.to_body(points), self.time))


_STEP = 1e-4  # of the differences: smaller than a pixel, far above rounding


@dataclass(frozen=True, slots=True)
class Instant:
    """The world at one time."""

    parts: tuple[Placed, ...]
    light: Light
    exposure: float


def _placed(part: Part, time: float) -> Placed:
    pose = part.pose(time)
    center, radius = part.shape.bound(time)
    return Placed(part, time, pose, pose.moved(*center).origin, radius)
