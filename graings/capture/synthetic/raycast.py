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
LONGEST_STEP: Final = 4.0  # in distances from a convex part; more would step over the place where a ray passes it
SHADOW_STEPS: Final = 40
SHADOW_START: Final = 0.012  # distance from a surface at which its own shadow ray begins
OCCLUSION_HEIGHTS: Final = (0.06, 0.18)
THIN: Final = 0.05  # parts of less than this width take no ambient light away
THREAD: Final = 0.025  # and of less than this cast no shadow: their penumbra is many times as wide
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
        rays, end = _near(placed, origins, directions, t, pixel)
        origin = placed.pose.to_body(origins if origins.shape[1] == 1 else origins[:, rays])
        direction = placed.pose.rotate_back(directions[:, rays])
        margin = 2.0 * pixel * _furthest(placed, origins)
        start, leave = _inside_box(placed, origin, direction, margin)
        end = np.minimum(end, leave)
        kept = np.flatnonzero((start < end) & (end > 0.0))
        if not len(kept):
            continue
        rays, direction = rays[kept], direction[:, kept]
        if origin.shape[1] > 1:
            origin = origin[:, kept]
        found, missed_by = march(placed, origin, direction, start[kept], end[kept])
        closer = found < t[rays]
        passes[rays] = np.minimum(passes[rays], np.where(np.isfinite(found), np.inf, missed_by))
        t[rays] = np.where(closer, found, t[rays])
        owner[rays[closer]] = index
    return Hits(t, owner, passes < pixel)


def _near(
    placed: Placed, origins: Array, directions: Array, limit: Array, pixel: float
) -> tuple[NDArray[np.int64], Array]:
    """Rays that enter the bounding sphere before `limit`, and where they leave it or reach that limit."""
    center = np.array(placed.center)[:, None]
    to_center = center - origins
    middle = dot(to_center, directions)
    square = dot(to_center, to_center)
    radius = placed.radius + 2.0 * pixel * np.sqrt(square)
    half = radius * radius - (square - middle * middle)
    rays = np.flatnonzero((half > 0.0) & (middle + radius > 0.0))
    reach = np.sqrt(half[rays])
    useful = (middle[rays] - reach < limit[rays]) & (middle[rays] + reach > 0.0)
    rays, reach = rays[useful], reach[useful]
    return rays, np.minimum(middle[rays] + reach, limit[rays])


def _width(placed: Placed) -> float:
    """The least side of the part's box."""
    low, high = placed.part.shape.box(placed.time)
    return min(high[axis] - low[axis] for axis in range(3))


def _furthest(placed: Placed, origins: Array) -> float:
    """The largest distance from an origin to the part."""
    to_center = np.array(placed.center)[:, None] - origins
    return float(np.sqrt(dot(to_center, to_center).max())) + placed.radius


def _inside_box(placed: Placed, origin: Array, direction: Array, margin: float) -> tuple[Array, Array]:
    """Where rays in body coordinates enter (0 where they begin inside) and leave the box of a part."""
    low, high = placed.part.shape.box(placed.time)
    start, end = np.zeros(direction.shape[1]), np.full(direction.shape[1], np.inf)
    for axis in range(3):
        step = direction[axis]
        inverse = 1.0 / np.where(np.abs(step) < 1e-12, 1e-12, step)
        a = (low[axis] - margin - origin[axis]) * inverse
        b = (high[axis] + margin - origin[axis]) * inverse
        start = np.maximum(start, np.minimum(a, b))
        end = np.minimum(end, np.maximum(a, b))
    return start, end


def march(placed: Placed, origin: Array, direction: Array, start: Array, end: Array) -> tuple[Array, Array]:
    """Where rays in body coordinates meet a part between `start` and `end` (infinity: nowhere), and how near they came
    to it per distance travelled."""
    shape, time = placed.part.shape, placed.time
    found = np.full(len(start), np.inf)
    missed_by = np.full(len(start), np.inf)
    active = np.arange(len(start))
    t, stop = start, end
    before, step = np.full(len(start), np.inf), np.ones(len(start))
    shared = origin.shape[1] == 1
    for _ in range(MAX_STEPS):
        gap = shape.distance(origin + t * direction, time)
        rate = (before - gap) / step  # at which the distance falls along the ray
        missed_by[active] = np.minimum(missed_by[active], gap / np.maximum(t, 1e-6))
        arrived = np.flatnonzero(gap < ON_SURFACE)
        if len(arrived):
            # One step of the secant method for the rest of the way.
            found[active[arrived]] = t[arrived] + gap[arrived] / np.clip(rate[arrived], 0.02, 1.0)
        step = gap
        going = (gap >= ON_SURFACE) & (t + gap < stop)
        if shape.convex:
            # Along a ray the distance from a convex shape is a convex function: the secant cannot lead past the
            # surface, and where the distance grows the ray has missed.
            going &= rate > 0.0
            step = gap / np.clip(rate, 1.0 / LONGEST_STEP, 1.0)
        before = gap
        if not going.all():
            kept = np.flatnonzero(going)
            if not len(kept):
                break
            active, t, stop, direction = active[kept], t[kept], stop[kept], direction[:, kept]
            before, step = before[kept], step[kept]
            if not shared:
                origin = origin[:, kept]
        t = t + step
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
        if isinstance(shape, Room) or _width(placed) < THREAD:
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
    shape = placed.part.shape
    origin, direction = placed.pose.to_body(points), placed.pose.rotate_back(toward)
    ratio = np.ones(len(start))
    active, t = np.arange(len(start)), start
    stop = end
    for _ in range(SHADOW_STEPS):
        gap = shape.distance(origin + t * direction, placed.time)
        now, best = gap / (softness * t), ratio[active]
        ratio[active] = np.minimum(best, now)
        t = t + np.maximum(0.8 * np.abs(gap), 0.012)
        going = (t < stop) & (now > -1.0)
        if shape.convex:  # the ratio falls and then rises
            going &= (now <= best) | (now > 1.0)
        if not going.all():
            kept = np.flatnonzero(going)
            if not len(kept):
                break
            active, t, stop, origin = active[kept], t[kept], stop[kept], origin[:, kept]
    return np.clip(ratio, -1.0, 1.0)


def open_share(instant: Instant, points: Array, normals: Array, parts: NDArray[np.int64]) -> Array:
    """Share [N] of the ambient light that nearby parts leave: distances at two heights above the surface."""
    share = np.ones(points.shape[1])
    top = OCCLUSION_HEIGHTS[-1]
    for index, placed in enumerate(instant.parts):
        shape = placed.part.shape
        if _width(placed) < THIN:
            continue
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
