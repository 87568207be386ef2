"""Triangulation of points from pairs of images.

For captures without a point cloud whose masks cover the whole image. SIFT features come from pycolmap, an optional
extra. Cameras are known: a match counts where the rays of its two pixels nearly intersect.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from graings.camera.camera import Camera
from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.colmap import import_pycolmap

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]

# Number of images, spread over the clip, and of nearest neighbours that each is matched with.
IMAGES: Final = 60
NEIGHBOURS: Final = 8

# Longer image side for SIFT in px: it takes a second; with four times as many 14 s and 3 GB.
MAX_SIFT_SIDE: Final = 1000

# Features per image, the strongest ones. SIFT finds 200 to 400 in an image of 400 px.
MAX_FEATURES: Final = 4096

# A feature's best match must be this much closer, as an angle between descriptors, than its second best (Lowe 2004).
RATIO: Final = 0.8

# Largest reprojection error in px: it leaves little room for wrong matches near the epipolar line.
MAX_REPROJECTION_ERROR: Final = 1.5

# Degrees between two rays, below which the depth of their intersection is too uncertain.
MIN_ANGLE: Final = 1.5

# Cosine between optical axes: cameras more than 60 degrees apart seldom see the same surface.
MIN_AXIS_COSINE: Final = 0.5

# Cells along the longer image side, each of which gets a point.
CELLS: Final = 12

LUMA: Final = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """SIFT features of one image: pixels [n, 2] (x, y) and unit descriptors [n, 128]."""

    pixels: Array
    descriptors: Tensor


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
    extractor = _extractor()
    chosen = [_at_most(frames[index]) for index in _spread(len(frames), IMAGES)]
    features = [_features(images.rgb(frame) @ LUMA, images.valid(frame), extractor) for frame in chosen]
    cameras = [frame.camera for frame in chosen]
    first = np.cumsum([0] + [len(each.pixels) for each in features])  # index of each image's first feature
    points, links = [np.empty((0, 3))], [np.empty((2, 0), np.int64)]
    for one, other in _neighbours(cameras, [frame.time for frame in chosen]):
        a, b = _matches(features[one].descriptors, features[other].descriptors)
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
    seen = seen[_in_front(camera, seen)]  # the median of a track need not be in front of every camera
    if len(seen) == 0:
        return np.empty((0, 3))
    pixels, depths = camera.project(seen)
    size = max(camera.width, camera.height) / CELLS
    u, v = np.meshgrid(np.arange(size / 2, camera.width, size), np.arange(size / 2, camera.height, size))
    middles = np.column_stack([u.ravel(), v.ravel()])
    apart = np.linalg.norm(middles[:, None] - pixels, axis=-1)
    empty = apart.min(axis=1) > size
    if valid is not None:
        empty &= _at(valid, middles)
    rays = _directions(camera, middles[empty])
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


def _extractor() -> pycolmap.FeatureExtractor:
    pycolmap = import_pycolmap()  # optional extra: importing it at the top would make every capture depend on it
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = MAX_FEATURES
    return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)


def _spread(count: int, most: int) -> list[int]:
    """At most `most` indices below `count`, evenly spaced."""
    chosen: list[int] = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
    return chosen


def _at_most(frame: Frame) -> Frame:
    camera, longest = frame.camera, max(frame.camera.width, frame.camera.height)
    if longest <= MAX_SIFT_SIDE:
        return frame
    width, height = (max(1, round(side * MAX_SIFT_SIDE / longest)) for side in (camera.width, camera.height))
    return replace(frame, camera=camera.resized(width, height))


def _features(
    gray: NDArray[np.float32], valid: NDArray[np.bool_] | None, extractor: pycolmap.FeatureExtractor
) -> Features:
    points, descriptors = extractor.extract_from_float32_array(gray)
    pixels = np.array([(point.x, point.y) for point in points], dtype=np.float64).reshape(-1, 2)
    unit = functional.normalize(torch.from_numpy(np.array(descriptors.data)).float(), dim=-1)
    if valid is None:
        return Features(pixels, unit)
    kept = _at(valid, pixels)
    return Features(pixels[kept], unit[torch.from_numpy(kept)])


def _at(valid: NDArray[np.bool_], pixels: Array) -> NDArray[np.bool_]:
    """Values of `valid` [H, W] at positions [n, 2] (x, y) in px, of the nearest pixel outside the image."""
    columns, rows = (np.clip(pixels[:, axis].astype(np.intp), 0, valid.shape[1 - axis] - 1) for axis in (0, 1))
    return np.asarray(valid[rows, columns])


def _neighbours(cameras: Sequence[Camera], times: Sequence[float]) -> Iterator[tuple[int, int]]:
    """Pairs of each camera and its nearest others with a similar viewing direction; ties by time."""
    centers = np.stack([camera.center for camera in cameras])
    forwards = np.stack([camera.forward for camera in cameras])
    moments = np.asarray(times)
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1)
    useful = (forwards @ forwards.T > MIN_AXIS_COSINE) & (apart > 1e-6 * max(1.0, float(apart.max())))
    pairs: set[tuple[int, int]] = set()
    for one in range(len(cameras)):
        order = np.lexsort((np.abs(moments - moments[one]), apart[one].round(6)))
        nearest = order[useful[one][order]][:NEIGHBOURS].tolist()
        pairs.update((min(one, other), max(one, other)) for other in nearest)
    yield from sorted(pairs)


def _matches(one: Tensor, other: Tensor) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of mutual best matches that pass the ratio test."""
    if len(one) == 0 or len(other) < 2:
        nothing = np.empty(0, np.int64)
        return nothing, nothing
    similarity = one @ other.T
    closest, index = similarity.topk(2, dim=-1)
    angles = closest.clamp(-1.0, 1.0).acos()
    mutual = similarity.argmax(0)[index[:, 0]] == torch.arange(len(one))
    kept = (mutual & (angles[:, 0] < RATIO * angles[:, 1])).nonzero().squeeze(-1)
    return kept.numpy(), index[kept, 0].numpy()


def ray_intersections(one: Camera, other: Camera, pixels: Array, others: Array) -> tuple[NDArray[np.int64], Array]:
    """Which pairs of pixels [m, 2] see one point, and these points: midway between the rays where they are closest."""
    a, b, base = _rays(one, pixels), _rays(other, others), other.center - one.center
    cosine = (a * b).sum(-1)
    wide = (np.arccos(np.clip(cosine, -1.0, 1.0)) > np.radians(MIN_ANGLE)).nonzero()[0]
    a, b, cosine = a[wide], b[wide], cosine[wide]
    along, across = a @ base, b @ base
    sine = 1.0 - cosine**2
    depth, depths = (along - cosine * across) / sine, (cosine * along - across) / sine
    points = 0.5 * (one.center + depth[:, None] * a + other.center + depths[:, None] * b)
    seen = _reprojects(one, points, pixels[wide]) & _reprojects(other, points, others[wide])
    met = (depth > 0) & (depths > 0) & seen
    return wide[met], points[met]


def _directions(camera: Camera, pixels: Array) -> Array:
    """Directions in the world of pixels [m, 2], scaled to one unit of depth."""
    local = np.column_stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(pixels))]
    )
    directions: Array = local @ camera.world_to_camera[:3, :3]
    return directions


def _rays(camera: Camera, pixels: Array) -> Array:
    """Unit directions in the world of pixels [m, 2]."""
    directions = _directions(camera, pixels)
    unit: Array = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return unit


def _reprojects(camera: Camera, points: Array, pixels: Array) -> NDArray[np.bool_]:
    """Whether `points` [m, 3] lie in front of `camera` and project to within the largest error of `pixels` [m, 2]."""
    deep = _in_front(camera, points)
    seen = np.zeros(len(points), np.bool_)
    at, _ = camera.project(points[deep])
    seen[deep] = np.linalg.norm(at - pixels[deep], axis=-1) < MAX_REPROJECTION_ERROR
    return seen


def _in_front(camera: Camera, points: Array) -> NDArray[np.bool_]:
    """Which of `points` [m, 3] are in front of the camera."""
    ahead: NDArray[np.bool_] = (points - camera.center) @ camera.forward > 0
    return ahead
