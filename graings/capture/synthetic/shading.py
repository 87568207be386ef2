"""Shading: the linear colour of surface points under a distant light and ambient light from above and below.

color = albedo (ambient(n) open + light max(n . l, 0) lit) + light gloss max(n . h, 0)^(2^sharpness) lit,
with h half-way between the light and the viewer; mirrors show what the reflected ray meets instead.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graings.capture.synthetic.exact import Array, Vector, cosine, dot, smooth, units
from graings.capture.synthetic.raycast import lit_share, open_share, trace
from graings.capture.synthetic.world import Instant


def shade(
    instant: Instant,
    points: Array,
    directions: Array,
    parts: NDArray[np.int64],
    pixel: float,
    *,
    mirrors: bool = True,
) -> Array:
    """Linear colours [3, N] of surface points of the given parts, seen along `directions`."""
    normals, albedo = np.empty_like(points), np.empty_like(points)
    gloss, mirror = np.zeros(points.shape[1]), np.zeros(points.shape[1])
    power = np.zeros(points.shape[1], dtype=np.int64)
    for index in np.unique(parts):
        chosen = np.flatnonzero(parts == index)
        placed = instant.parts[index]
        normals[:, chosen] = placed.normals(points[:, chosen])
        albedo[:, chosen] = placed.colors(points[:, chosen])
        gloss[chosen], power[chosen], mirror[chosen] = placed.part.gloss, placed.part.sharpness, placed.part.mirror
    light = instant.light
    facing = np.maximum(dot(light.direction, normals), 0.0)
    lit = np.zeros(points.shape[1])
    bright = np.flatnonzero(facing > 0.0)
    lit[bright] = lit_share(instant, points[:, bright], normals[:, bright], parts[bright])
    opening = open_share(instant, points, normals, parts)
    upward = 0.5 + 0.5 * normals[2]
    shine = _highlight(light.direction, normals, directions, gloss, power) * lit
    colors = np.stack(
        [
            albedo[c]
            * ((light.ground[c] + (light.sky[c] - light.ground[c]) * upward) * opening + light.color[c] * facing * lit)
            + light.color[c] * shine
            for c in range(3)
        ]
    )
    if mirrors:
        polished = np.flatnonzero(mirror > 0.0)
        if len(polished):
            seen = _reflected(instant, points[:, polished], directions[:, polished], normals[:, polished], pixel)
            share = mirror[polished]
            colors[:, polished] = colors[:, polished] * (1.0 - share) + seen * share * albedo[:, polished]
            colors[:, polished] += np.array(light.color)[:, None] * shine[polished] * share
    return colors


def _highlight(light: Vector, normals: Array, directions: Array, gloss: Array, power: NDArray[np.int64]) -> Array:
    """The term with h, before the light's colour."""
    result = np.zeros(len(gloss))
    glossy = np.flatnonzero(gloss > 0.0)
    if len(glossy):
        half = units(np.array(light)[:, None] - directions[:, glossy])
        value = np.maximum(dot(half, normals[:, glossy]), 0.0)
        for step in range(int(power[glossy].max())):
            value = np.where(power[glossy] > step, value * value, value)
        result[glossy] = gloss[glossy] * value
    return result


def _reflected(instant: Instant, points: Array, directions: Array, normals: Array, pixel: float) -> Array:
    """What mirrors show at `points`: surfaces without further mirrors, and else the surroundings."""
    away = directions - 2.0 * dot(directions, normals) * normals
    origins = points + 2e-3 * normals
    hits = trace(instant, origins, away, pixel)
    colors = surroundings(away)
    met = np.flatnonzero(hits.part >= 0)
    if len(met):
        reached = origins[:, met] + hits.t[met] * away[:, met]
        colors[:, met] = shade(instant, reached, away[:, met], hits.part[met], pixel, mirrors=False)
    return colors


def surroundings(directions: Array) -> Array:
    """What mirrors see beyond all parts: a sky over dark ground with a ring of soft windows."""
    up = directions[2]
    sky = smooth(0.5 + 2.2 * up)
    horizon = np.clip(1.0 - 3.0 * np.abs(up), 0.0, 1.0)
    across = np.maximum(np.sqrt(directions[0] * directions[0] + directions[1] * directions[1]), 1e-6)
    c, s = directions[0] / across, directions[1] / across
    c, s = c * (c * c - 3.0 * s * s), s * (3.0 * c * c - s * s)  # the angle three times: three windows
    window = smooth(4.0 * (c - 0.35)) * smooth(6.0 * (up - 0.15)) * smooth(6.0 * (0.75 - up))
    low, high = (0.10, 0.09, 0.09), (0.30, 0.42, 0.62)
    glow = 0.5 + 0.5 * cosine(0.25 * up)
    return np.stack(
        [low[i] + (high[i] - low[i]) * sky + horizon * (0.22, 0.19, 0.15)[i] * glow + 0.75 * window for i in range(3)]
    )
