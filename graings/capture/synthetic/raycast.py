"""Rays through an instant: the nearest surface by sphere tracing (Hart 1996), soft shadows and ambient occlusion.

Every part has a bounding sphere, so that rays far from it cost nothing. Lengths are in world units; directions have
length 1; points and directions are [3, N] arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.capture.synthetic.exact import Array, Vector, dot
from graings.capture.synthetic.shapes import Room
from graings.capture.synthetic.world import Instant, Placed

MAX_STEPS: Final = 160
ON_SURFACE: Final = 1e-5  # a ray has arrived at this distance
SHADOW_STEPS: Final = 40
SHADOW_START: Final = 0.012  # distance from a surface at which its own shadow ray begins
OCCLUSION_HEIGHTS: Final = (0.06, 0.18)
OCCLUSION: Final = 0.45  # how much of the ambient light one touching part takes away


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What rays meet: `t` [N] along each (infinity: nothing), index of the part (-1: none), and whether the ray passes
    a part within about a pixel without meeting it."""

    t: Array
    part: NDArray[np.int64]
    grazes: NDArray[np.bool_]


def trace(instant: Instant, origins: Array, directions: Array, pixel: float) -> Hits:
    """The nearest surfaces along rays from `origins` [3, 1] or [3, N]; `pixel` is the width of a pixel per distance."""
    count = directions.shape[1]
    t = np.full(count, np.inf)
    owner = np.full(count, -1)
    passes = np.full(count, np.inf)  # least distance to a part that is not met, per distance travelled
    for index, placed in enumerate(instant.parts):
        if isinstance(placed.part.shape, Room):
            wall = placed.part.shape.exit(placed.pose.to_body(origins), placed.pose.rotate_back(directions))
            owner[wall < t] = index
            t = np.minimum(t, wall)
            continue
        rays, start, end = _near(placed, origins, directions, t, pixel)
        if not len(rays):
            continue
        found, missed_by = _march(placed, origins, directions, rays, start, end)
        closer = found < t[rays]
        passes[rays] = np.minimum(passes[rays], np.where(np.isfinite(found), np.inf, missed_by))
        t[rays] = np.where(closer, found, t[rays])
        owner[rays[closer]] = index
    return Hits(t, owner, passes < pixel)


def _near(
    placed: Placed, origins: Array, directions: Array, limit: Array, pixel: float
) -> tuple[NDArray[np.int64], Array, Array]:
    """Rays that enter the bounding sphere before `limit`, and where they enter and leave it."""
    center = np.array(placed.center)[:, None]
    to_center = center - origins
    middle = dot(to_center, directions)
    square = dot(to_center, to_center)
    distance = np.sqrt(square)
    radius = placed.radius + 2.0 * pixel * distance
    half = radius * radius - (square - middle * middle)
    rays = np.flatnonzero((half > 0.0) & (middle + radius > 0.0))
    reach = np.sqrt(half[rays])
    start = np.maximum(middle[rays] - reach, 0.0)
    end = middle[rays] + reach
    useful = (start < limit[rays]) & (end > 0.0)
    return rays[useful], start[useful], np.minimum(end[useful], limit[rays[useful]])


def _march(
    placed: Placed, origins: Array, directions: Array, rays: NDArray[np.int64], start: Array, end: Array
) -> tuple[Array, Array]:
    """Where rays meet a part (infinity: nowhere), and how near they came to it per distance travelled."""
    shape, time = placed.part.shape, placed.time
    origin = placed.pose.to_body(origins if origins.shape[1] == 1 else origins[:, rays])
    direction = placed.pose.rotate_back(directions[:, rays])
    found = np.full(len(rays), np.inf)
    missed_by = np.full(len(rays), np.inf)
    active = np.arange(len(rays))
    t, stop = start.copy(), end
    before, step = np.zeros(len(rays)), np.zeros(len(rays))
    shared = origin.shape[1] == 1
    for _ in range(MAX_STEPS):
        gap = shape.distance(origin + t * direction, time)
        arrived = gap < ON_SURFACE
        if arrived.any():
            # One step of the secant method: the rest of the way at the rate at which the distance fell.
            rate = np.clip((before - gap) / np.maximum(step, 1e-12), 0.02, 1.0)
            found[active[arrived]] = (t + gap / rate)[arrived]
        missed_by[active] = np.minimum(missed_by[active], gap / np.maximum(t, 1e-6))
        going = ~arrived & (t + gap < stop)
        if not going.all():
            active = active[going]
            if not len(active):
                break
            t, gap, stop, direction = t[going], gap[going], stop[going], direction[:, going]
            if not shared:
                origin = origin[:, going]
        t = t + gap
        before, step = gap, gap
    return found, missed_by


def lit_share(instant: Instant, points: Array, normals: Array, parts: NDArray[np.int64]) -> Array:
    """Share [N] of the distant light that reaches surface points of the given parts past all other parts."""
    light: Vector = instant.light.direction
    softness = instant.light.softness
    raised = points + 1e-3 * normals
    toward = np.array(light)[:, None]
    share = np.ones(points.shape[1])
    for index, placed in enumerate(instant.parts):
        shape = placed.part.shape
        if isinstance(shape, Room):
            continue
        to_center = np.array(placed.center)[:, None] - raised
        middle = dot(to_center, light)
        square = dot(to_center, to_center) - middle * middle
        reach = placed.radius + softness * np.maximum(middle + placed.radius, 0.0)
        close = (square < reach * reach) & (middle + placed.radius > 0.0)
        if shape.convex:
            close &= parts != index
        chosen = np.flatnonzero(close)
        if not len(chosen):
            continue
        half = np.sqrt(reach[chosen] * reach[chosen] - square[chosen])
        start = np.maximum(middle[chosen] - half, SHADOW_START)
        ratio = _penumbra(placed, raised[:, chosen], toward, start, middle[chosen] + half, softness)
        blocked = 0.25 * (1.0 + ratio) * (1.0 + ratio) * (2.0 - ratio)
        share[chosen] = np.minimum(share[chosen], blocked)
    return share


def _penumbra(placed: Placed, points: Array, toward: Array, start: Array, end: Array, softness: float) -> Array:
    """Least ratio of the distance from the part to the half-width of the penumbra along shadow rays, in [-1, 1]."""
    origin, direction = placed.pose.to_body(points), placed.pose.rotate_back(toward)
    ratio = np.ones(len(start))
    active, t = np.arange(len(start)), start
    stop = end
    for _ in range(SHADOW_STEPS):
        gap = placed.part.shape.distance(origin + t * direction, placed.time)
        ratio[active] = np.minimum(ratio[active], gap / (softness * t))
        t = t + np.maximum(0.8 * np.abs(gap), 0.012)
        going = (t < stop) & (ratio[active] > -1.0)
        if not going.all():
            active, t, stop, origin = active[going], t[going], stop[going], origin[:, going]
            if not len(active):
                break
    return np.clip(ratio, -1.0, 1.0)


def open_share(instant: Instant, points: Array, normals: Array, parts: NDArray[np.int64]) -> Array:
    """Share [N] of the ambient light that nearby parts leave: distances at two heights above the surface."""
    share = np.ones(points.shape[1])
    top = OCCLUSION_HEIGHTS[-1]
    for index, placed in enumerate(instant.parts):
        shape = placed.part.shape
        offset = points - np.array(placed.center)[:, None]
        limit = placed.radius + top
        close = dot(offset, offset) < limit * limit
        if shape.convex:
            close &= parts != index
        chosen = np.flatnonzero(close)
        if not len(chosen):
            continue
        covered = np.zeros(len(chosen))
        for height in OCCLUSION_HEIGHTS:
            gap = placed.distance(points[:, chosen] + height * normals[:, chosen])
            covered = covered + np.clip((height - gap) / height, 0.0, 1.0)
        share[chosen] = share[chosen] * (1.0 - OCCLUSION / len(OCCLUSION_HEIGHTS) * covered)
    return share
