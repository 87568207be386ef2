"""Surface points of a world and where they are at each time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.capture.synthetic.exact import Array, dot, uniform, units
from graings.capture.synthetic.raycast import march
from graings.capture.synthetic.shapes import Room
from graings.capture.synthetic.world import Placed, World

CANDIDATES: Final = 8  # chords for each point that is wanted: some miss, and some points lie inside other parts
REFINEMENTS: Final = 40
ON_SURFACE: Final = 1e-6
CHECKS: Final = 16  # times at which a point must lie outside all other parts


def track(world: World, seed: int, times: Sequence[float], count: int = 200) -> Array:
    """Positions [T, count, 3] of surface points at ascending `times`; of moving parts, where there are any.

    A point keeps its material coordinates. It lies on the surface at all times and outside the other parts at most.
    """
    chosen = [index for index, part in enumerate(world.parts) if part.moves] or [
        index for index, part in enumerate(world.parts) if not isinstance(part.shape, Room)
    ]
    first = world.at(times[0]).parts
    numbers = uniform(seed, "tracked points", 7 * CANDIDATES * count).reshape(7, -1)
    owners = _owners([first[index] for index in chosen], numbers[6])
    material, owner, order = [], [], []
    for place, index in enumerate(chosen):
        candidates = np.flatnonzero(owners == place)
        points, kept = _on_surface(first[index], numbers[:6, candidates])
        material.append(first[index].part.shape.material(points, times[0]))
        owner.append(np.full(points.shape[1], index))
        order.append(candidates[kept])
    # In the order of the random numbers, so that the first `count` are spread over all parts.
    sequence = np.argsort(np.concatenate(order), kind="stable")
    coordinates, belongs = np.concatenate(material, axis=1)[:, sequence], np.concatenate(owner)[sequence]
    outside = _stays_outside(world, coordinates, belongs, [times[k] for k in _spread(len(times), CHECKS)])
    selected = np.flatnonzero(outside)[:count]
    if len(selected) < count:
        raise ValueError(f"only {len(selected)} of {count} points on the surface were found")
    return np.stack([_place(world, coordinates[:, selected], belongs[selected], time).T for time in times])


def _owners(parts: Sequence[Placed], numbers: Array) -> NDArray[np.int64]:
    """Index of the part of each candidate, by the share of a part's box in the surface of all."""
    shares = []
    for placed in parts:
        low, high = placed.part.shape.box(placed.time)
        a, b, c = (high[axis] - low[axis] for axis in range(3))
        shares.append(a * b + b * c + c * a)
    edges, total = [], 0.0
    for share in shares:
        total += share
        edges.append(total)
    return np.searchsorted(np.array(edges[:-1]), numbers * total, side="right")


def _on_surface(placed: Placed, numbers: Array) -> tuple[Array, NDArray[np.int64]]:
    """Body points where random chords of the part's box enter it, and which of the chords [6, N] do."""
    shape, time = placed.part.shape, placed.time
    low, high = (np.array(corner)[:, None] for corner in shape.box(time))
    through = low + (high - low) * numbers[:3]
    direction = units(2.0 * numbers[3:] - 1.0)
    origins = through - 2.0 * placed.radius * direction
    count = direction.shape[1]
    reach, _ = march(placed, origins, direction, np.zeros(count), np.full(count, 4.0 * placed.radius))
    near = np.flatnonzero(np.isfinite(reach))
    points = origins[:, near] + reach[near] * direction[:, near]
    gap = shape.distance(points, time)
    for _ in range(REFINEMENTS):
        if np.abs(gap).max(initial=0.0) < 1e-3 * ON_SURFACE:
            break
        points = points - gap * _gradient(placed, points)
        gap = shape.distance(points, time)
    exact = np.abs(gap) < 0.1 * ON_SURFACE
    return points[:, exact], near[exact]


def _gradient(placed: Placed, points: Array) -> Array:
    return placed.pose.rotate_back(placed.normals(placed.pose.to_world(points)))


def _place(world: World, material: Array, owner: NDArray[np.int64], time: float) -> Array:
    """World positions [3, N] of material points of the parts `owner`."""
    positions = np.empty_like(material)
    for index in np.unique(owner):
        part = world.parts[index]
        of_part = np.flatnonzero(owner == index)
        positions[:, of_part] = part.pose(time).to_world(part.shape.place(material[:, of_part], time))
    return positions


def _stays_outside(
    world: World, material: Array, owner: NDArray[np.int64], times: Sequence[float]
) -> NDArray[np.bool_]:
    """Whether points lie on their own part and outside all others at `times`."""
    good = np.ones(material.shape[1], dtype=bool)
    for time in times:
        positions = _place(world, material, owner, time)
        for index, placed in enumerate(world.at(time).parts):
            own = owner == index
            offset = positions - np.array(placed.center)[:, None]
            close = np.flatnonzero(good & (dot(offset, offset) < (placed.radius + 1e-3) * (placed.radius + 1e-3)))
            gap = placed.distance(positions[:, close])
            good[close] &= np.where(own[close], np.abs(gap) < ON_SURFACE, gap > 0.0)
    return good


def _spread(size: int, count: int) -> list[int]:
    return sorted({round(k * (size - 1) / max(count - 1, 1)) for k in range(count)})
