"""Triangulation of points from pairs of images.

For captures without a point cloud whose masks cover the whole image. SIFT features come from pycolmap, an optional
extra. Cameras are known: a match counts where the rays of its two pixels nearly intersect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.matching.features import MAX_SIFT_SIDE, at, extract, matches, neighbours, reduced
from graings.matching.rays import directions, in_front, ray_intersections

Array = NDArray[np.float64]

# Number of images, spread over the clip.
IMAGES: Final = 60

# Cells along the longer image side, each of which gets a point.
CELLS: Final = 12


@dataclass(frozen=True, slots=True, eq=False)
class Triangulated:
    """Triangulated points [M, 3], and points [K, 3] filled in between them; normalised units."""

    points: Array
    filled: Array


def triangulate(frames: Sequence[Frame], images: ImageStore) -> Triangulated:
    """Points that two or more of `frames` see, and points in the cells of each image that have none.

    Matches that share a feature form a track, whose point is the median of its intersections. Raises `ImportError`
    without pycolmap, and `CaptureError` where an image cannot be read.
    """
    chosen = [reduced(frames[index], MAX_SIFT_SIDE) for index in _spread(len(frames), IMAGES)]
    features = extract(chosen, images)
    cameras = [frame.camera for frame in chosen]
    first = np.cumsum([0] + [len(each.pixels) for each in features])  # index of each image's first feature
    points, links = [np.empty((0, 3))], [np.empty((2, 0), np.int64)]
    for one, other in neighbours(cameras, [frame.time for frame in chosen]):
        a, b = matches(features[one].descriptors, features[other].descriptors)
        met, where = ray_intersections(cameras[one], cameras[other], features[one].pixels[a], features[other].pixels[b])
        points.append(where)
        links.append(np.stack([first[one] + a[met], first[other] + b[met]]))
    ends = np.concatenate(links, axis=1)
    track_ids, number = np.unique(tracks(ends, int(first[-1])), return_inverse=True)
    found = _medians(np.concatenate(points), number, len(track_ids))
    filled = [np.empty((0, 3))]
    for frame, begin, end in zip(chosen, first[:-1], first[1:], strict=True):
        own = ((ends >= begin) & (ends < end)).any(axis=0)
        filled.append(fill_untextured(frame.camera, found[np.unique(number[own])], images.valid(frame)))
    return Triangulated(found, np.concatenate(filled))


def fill_untextured(camera: Camera, seen: Array, valid: NDArray[np.bool_] | None = None) -> Array:
    """A point [K, 3] for each cell of an image without any of the points `seen` [m, 3], at the depth of the nearest.

    Cells whose middle is not `valid` [H, W] get none. Surfaces without texture, a wall or the sky, have no features;
    growth needs anchors near them.
    """
    seen = seen[in_front(camera, seen)]  # the median of a track need not be in front of every camera
    if len(seen) == 0:
        return np.empty((0, 3))
    pixels, depths = camera.project(seen)
    size = max(camera.width, camera.height) / CELLS
    u, v = np.meshgrid(np.arange(size / 2, camera.width, size), np.arange(size / 2, camera.height, size))
    middles = np.column_stack([u.ravel(), v.ravel()])
    apart = np.linalg.norm(middles[:, None] - pixels, axis=-1)
    empty = apart.min(axis=1) > size
    if valid is not None:
        empty &= at(valid, middles)
    rays = directions(camera, middles[empty])
    points: Array = camera.center + depths[apart.argmin(axis=1)[empty], None] * rays
    return points


def tracks(links: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """For each of `links` [2, m] between features below `count`, the lowest index of its connected component."""
    lowest = np.arange(count)
    while True:
        least = np.minimum(lowest[links[0]], lowest[links[1]])
        before = lowest.copy()
        for end in links:
            np.minimum.at(lowest, end, least)
        lowest = lowest[lowest]
        if np.array_equal(lowest, before):
            return least


def _medians(points: Array, number: NDArray[np.int64], count: int) -> Array:
    """[count, 3]: the median of each axis over those of `points` [m, 3] that have the same `number`."""
    parts = np.split(points[np.argsort(number, kind="stable")], np.cumsum(np.bincount(number, minlength=count))[:-1])
    return np.array([np.median(part, axis=0) for part in parts if len(part)]).reshape(-1, 3)


def _spread(count: int, most: int) -> list[int]:
    """At most `most` indices below `count`, evenly spaced."""
    chosen: list[int] = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
    return chosen
