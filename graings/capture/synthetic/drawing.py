"""draw: one view of a world as 8-bit pixels, with depth and a mask of what moves.

A first pass casts one ray through the centre of each pixel. Pixels at silhouettes, and those whose colour differs from
a neighbour's, are then drawn again as the mean of a grid of rays. Images hold the square root of linear light (a gamma
of 2); means are taken of these values, as alpha compositing later does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.capture.synthetic.exact import Array
from graings.capture.synthetic.raycast import trace
from graings.capture.synthetic.shading import shade
from graings.capture.synthetic.viewpoint import Viewpoint
from graings.capture.synthetic.world import Instant, World

RAYS_AT_ONCE: Final = 1 << 18  # about a hundred megabytes
# Positions of rays in a pixel: no two in one row, column or main diagonal, so that edges of all directions are sampled
# finely. Eight at silhouettes, four where only colours differ.
_QUEENS: Final = (0, 4, 7, 5, 2, 6, 1, 3)
AT_SILHOUETTES: Final = tuple(((i + 0.5) / 8, (j + 0.5) / 8) for i, j in enumerate(_QUEENS))
AT_CONTRASTS: Final = tuple(((i + 0.5) / 4, (j + 0.5) / 4) for i, j in enumerate((1, 3, 0, 2)))
CONTRAST: Final = 0.1  # difference of neighbouring values from which on one ray is not enough


@dataclass(frozen=True, slots=True, eq=False)
class DrawnView:
    """What a camera sees. `rgba` [H, W, 4] has straight alpha; `depth` [H, W] is that of the pixel's centre along the
    optical axis in capture units, 0 where there is nothing; `moving` [H, W] is the share of the pixel that moving parts
    cover, 255 for all."""

    rgba: NDArray[np.uint8]
    depth: NDArray[np.float32]
    moving: NDArray[np.uint8]


def draw(world: World, viewpoint: Viewpoint, time: float) -> DrawnView:
    """The view of `viewpoint` at `time`."""
    instant = world.at(time)
    size = viewpoint.size
    rows, columns = np.divmod(np.arange(size * size), size)
    color, depth, part, grazes = _cast(instant, viewpoint, columns + 0.5, rows + 0.5)
    covered = part >= 0
    moves = np.array([placed.part.moves for placed in instant.parts] + [False])
    alpha, moving = covered.astype(np.float64), moves[part].astype(np.float64)
    silhouette, contrast = _needs_more(color, part, grazes, size)
    groups = [
        (np.flatnonzero(silhouette), np.array(AT_SILHOUETTES)),
        (np.flatnonzero(contrast & ~silhouette), np.array(AT_CONTRASTS)),
    ]
    fine_columns = np.concatenate([(columns[again][:, None] + offsets[:, 0]).reshape(-1) for again, offsets in groups])
    fine_rows = np.concatenate([(rows[again][:, None] + offsets[:, 1]).reshape(-1) for again, offsets in groups])
    fine_color, _, fine_part, _ = _cast(instant, viewpoint, fine_columns, fine_rows)
    first = 0
    for again, offsets in groups:
        count, rays = len(again), len(offsets)
        colors = fine_color[:, first : first + count * rays].reshape(3, count, rays)
        parts = fine_part[first : first + count * rays].reshape(count, rays)
        first += count * rays
        hits = (parts >= 0).sum(axis=1)
        total = np.zeros((3, count))
        for ray in range(rays):  # one after the other: a library may sum in any order
            total = total + colors[:, :, ray]
        color[:, again] = total / np.maximum(hits, 1)
        alpha[again] = hits / rays
        moving[again] = moves[parts].sum(axis=1) / rays
    rgba = np.concatenate([color, alpha[None]]).T.reshape(size, size, 4)
    return DrawnView(
        rgba=np.rint(rgba * 255.0).astype(np.uint8),
        depth=np.where(covered, depth, 0.0).reshape(size, size).astype(np.float32),
        moving=np.rint(moving * 255.0).astype(np.uint8).reshape(size, size),
    )


def _cast(
    instant: Instant, viewpoint: Viewpoint, columns: Array, rows: Array
) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.bool_]]:
    """Stored colours [3, N] (0 where there is nothing), depths, parts and near misses at image positions in pixels."""
    count = len(columns)
    color, depth = np.zeros((3, count)), np.zeros(count)
    part, grazes = np.full(count, -1), np.zeros(count, dtype=bool)
    origin = np.array(viewpoint.origin)[:, None]
    for first in range(0, count, RAYS_AT_ONCE):
        piece = slice(first, first + RAYS_AT_ONCE)
        directions, forward = viewpoint.rays(columns[piece], rows[piece])
        hits = trace(instant, origin, directions, viewpoint.pixel)
        met = np.flatnonzero(hits.part >= 0)
        part[piece], grazes[piece] = hits.part, hits.grazes
        if len(met):
            points = origin + hits.t[met] * directions[:, met]
            linear = shade(instant, points, directions[:, met], hits.part[met], viewpoint.pixel)
            color[:, first + met] = np.sqrt(np.clip(linear * instant.exposure, 0.0, 1.0))
            depth[first + met] = hits.t[met] * forward[met]
    return color, depth, part, grazes


def _needs_more(
    color: Array, part: NDArray[np.int64], grazes: NDArray[np.bool_], size: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels [N] with another part next to them or passing nearby, and those with another colour next to them."""
    image, owner = color.reshape(3, size, size), part.reshape(size, size)
    silhouette, contrast = grazes.reshape(size, size).copy(), np.zeros((size, size), dtype=bool)
    for axis in (0, 1):
        ahead = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        behind = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        other_part = owner[ahead] != owner[behind]
        other_color = np.abs(image[:, *ahead] - image[:, *behind]).max(axis=0) > CONTRAST
        for pixels, differs in ((silhouette, other_part), (contrast, other_color)):
            pixels[ahead] |= differs
            pixels[behind] |= differs
    return silhouette.reshape(-1), contrast.reshape(-1)
