"""Triangulation: places in space that pairs of pictures agree on.

For captures whose pictures show something everywhere and that bring no cloud of points. Features are pycolmap's, an
optional extra. Cameras are known, so nothing is estimated: a match counts where the rays of its two pixels meet. Knows
nothing of anchors or training.
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

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]

# So many pictures are looked at, spread over the clip, and each beside so many of its nearest neighbours.
PICTURES: Final = 60
NEIGHBOURS: Final = 8

# Pixels along the longer side that are looked at: SIFT takes a second for so many, and 14 and 3 GB for four times that.
LONGEST: Final = 1000

# Features of a picture, the most distinct ones. SIFT finds 200 to 400 in one of 400 px.
MOST_FEATURES: Final = 4096

# A feature's best match must be this much closer, as an angle between descriptors, than its second best (Lowe 2004).
RATIO: Final = 0.8

# Pixels between a feature and its place in space as either camera sees it. A wrong match that lies on the right line
# by chance has few pixels to do so.
MAX_DISTANCE: Final = 1.5

# Degrees between two rays, below which the depth of where they meet says little.
LEAST_ANGLE: Final = 1.5

# Pictures that look more than 60 degrees apart seldom show the same side of anything.
LEAST_ALIKE: Final = 0.5

# Parts along the longer side of a picture, in each of which there should be a place.
PARTS: Final = 12

LUMA: Final = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """What stands out in one picture: pixels [n, 2] (x, y) and unit descriptors [n, 128]."""

    pixels: Array
    descriptors: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class Triangulated:
    """Places [M, 3] that pictures agree on, and those [K, 3] guessed in between; normalised units."""

    places: Array
    filled: Array


def triangulate(frames: Sequence[Frame], images: ImageStore) -> Triangulated:
    """Places of what two of `frames` and more see, and of what lies between these in each picture.

    Matches that share a feature are one thing, and its place is the median of theirs. Where nothing stands out there
    are none. Raises `ImportError` without pycolmap, and `CaptureError` where a picture cannot be read.
    """
    extractor = _extractor()
    chosen = [_no_longer(frames[index]) for index in _spread(len(frames), PICTURES)]
    features = [_features(images.rgb(frame) @ LUMA, extractor) for frame in chosen]
    cameras = [frame.camera for frame in chosen]
    first = np.cumsum([0] + [len(each.pixels) for each in features])  # number of each picture's first feature
    places, links = [np.empty((0, 3))], [np.empty((2, 0), np.int64)]
    for one, other in _neighbours(cameras, [frame.time for frame in chosen]):
        a, b = _matches(features[one].descriptors, features[other].descriptors)
        met, where = ray_intersections(cameras[one], cameras[other], features[one].pixels[a], features[other].pixels[b])
        places.append(where)
        links.append(np.stack([first[one] + a[met], first[other] + b[met]]))
    ends = np.concatenate(links, axis=1)
    things, number = np.unique(tracks(ends, int(first[-1])), return_inverse=True)
    found = _medians(np.concatenate(places), number, len(things))
    guessed = [np.empty((0, 3))]
    for camera, begin, end in zip(cameras, first[:-1], first[1:], strict=True):
        own = ((ends >= begin) & (ends < end)).any(axis=0)
        guessed.append(fill_between(camera, found[np.unique(number[own])]))
    return Triangulated(found, np.concatenate(guessed))


def fill_between(camera: Camera, seen: Array) -> Array:
    """One place [K, 3] for each part of a picture without any of those `seen` [m, 3], as deep as the nearest is.

    What looks the same everywhere, a wall or the sky, has no features; what grows later needs something near it.
    """
    seen = seen[_in_front(camera, seen)]  # the median of a thing's places need not be where each of them is
    if len(seen) == 0:
        return np.empty((0, 3))
    pixels, depths = camera.project(seen)
    size = max(camera.width, camera.height) / PARTS
    u, v = np.meshgrid(np.arange(size / 2, camera.width, size), np.arange(size / 2, camera.height, size))
    middles = np.column_stack([u.ravel(), v.ravel()])
    apart = np.linalg.norm(middles[:, None] - pixels, axis=-1)
    empty = apart.min(axis=1) > size
    rays = _towards(camera, middles[empty])
    places: Array = camera.center + depths[apart.argmin(axis=1)[empty], None] * rays
    return places


def tracks(links: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """For each of `links` [2, m] of things numbered below `count`, the lowest number that it hangs together with."""
    lowest = np.arange(count)
    while True:
        least = np.minimum(lowest[links[0]], lowest[links[1]])
        before = lowest.copy()
        for end in links:
            np.minimum.at(lowest, end, least)
        lowest = lowest[lowest]
        if np.array_equal(lowest, before):
            return least


def _medians(places: Array, number: NDArray[np.int64], count: int) -> Array:
    """[count, 3]: the median of each axis over those of `places` [m, 3] that have the same `number`."""
    parts = np.split(places[np.argsort(number, kind="stable")], np.cumsum(np.bincount(number, minlength=count))[:-1])
    return np.array([np.median(part, axis=0) for part in parts if len(part)]).reshape(-1, 3)


def _extractor() -> pycolmap.FeatureExtractor:
    import pycolmap  # optional extra: importing it at the top would make every capture depend on it

    pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING.value  # it tells everybody that it begins
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = MOST_FEATURES
    return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)


def _spread(count: int, most: int) -> list[int]:
    """At most `most` of the numbers below `count`, evenly."""
    chosen: list[int] = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
    return chosen


def _no_longer(frame: Frame) -> Frame:
    camera, longest = frame.camera, max(frame.camera.width, frame.camera.height)
    if longest <= LONGEST:
        return frame
    width, height = (max(1, round(side * LONGEST / longest)) for side in (camera.width, camera.height))
    return replace(frame, camera=camera.resized(width, height))


def _features(gray: NDArray[np.float32], extractor: pycolmap.FeatureExtractor) -> Features:
    points, descriptors = extractor.extract_from_float32_array(gray)
    pixels = np.array([(point.x, point.y) for point in points], dtype=np.float64).reshape(-1, 2)
    return Features(pixels, functional.normalize(torch.from_numpy(np.array(descriptors.data)).float(), dim=-1))


def _neighbours(cameras: Sequence[Camera], times: Sequence[float]) -> Iterator[tuple[int, int]]:
    """Each camera with the nearest others that look about the same way from elsewhere; of equally near, by time."""
    centers = np.stack([camera.center for camera in cameras])
    forwards = np.stack([camera.forward for camera in cameras])
    moments = np.asarray(times)
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1)
    useful = (forwards @ forwards.T > LEAST_ALIKE) & (apart > 1e-6 * max(1.0, float(apart.max())))
    pairs: set[tuple[int, int]] = set()
    for one in range(len(cameras)):
        order = np.lexsort((np.abs(moments - moments[one]), apart[one].round(6)))
        nearest = order[useful[one][order]][:NEIGHBOURS].tolist()
        pairs.update((min(one, other), max(one, other)) for other in nearest)
    yield from sorted(pairs)


def _matches(one: Tensor, other: Tensor) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of features that are each other's best match, and by far the best for the first."""
    if len(one) == 0 or len(other) < 2:
        nothing = np.empty(0, np.int64)
        return nothing, nothing
    alike = one @ other.T
    closest, index = alike.topk(2, dim=-1)
    angles = closest.clamp(-1.0, 1.0).acos()
    mutual = alike.argmax(0)[index[:, 0]] == torch.arange(len(one))
    kept = (mutual & (angles[:, 0] < RATIO * angles[:, 1])).nonzero().squeeze(-1)
    return kept.numpy(), index[kept, 0].numpy()


def ray_intersections(one: Camera, other: Camera, pixels: Array, others: Array) -> tuple[NDArray[np.int64], Array]:
    """Which pairs of pixels [m, 2] see one place, and that: the middle between the nearest points of their rays."""
    a, b, base = _rays(one, pixels), _rays(other, others), other.center - one.center
    cosine = (a * b).sum(-1)
    wide = (np.arccos(np.clip(cosine, -1.0, 1.0)) > np.radians(LEAST_ANGLE)).nonzero()[0]
    a, b, cosine = a[wide], b[wide], cosine[wide]
    along, across = a @ base, b @ base
    sine = 1.0 - cosine**2
    depth, depths = (along - cosine * across) / sine, (cosine * along - across) / sine
    places = 0.5 * (one.center + depth[:, None] * a + other.center + depths[:, None] * b)
    seen = _sees(one, places, pixels[wide]) & _sees(other, places, others[wide])
    met = (depth > 0) & (depths > 0) & seen
    return wide[met], places[met]


def _towards(camera: Camera, pixels: Array) -> Array:
    """Directions in the world of pixels [m, 2], as long as it takes to get one unit deeper."""
    local = np.column_stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(pixels))]
    )
    directions: Array = local @ camera.world_to_camera[:3, :3]
    return directions


def _rays(camera: Camera, pixels: Array) -> Array:
    """Unit directions in the world of pixels [m, 2]."""
    directions = _towards(camera, pixels)
    unit: Array = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return unit


def _sees(camera: Camera, places: Array, pixels: Array) -> NDArray[np.bool_]:
    """Whether `camera` sees `places` [m, 3] in front of it and not `MAX_DISTANCE` from `pixels` [m, 2]."""
    deep = _in_front(camera, places)
    seen = np.zeros(len(places), np.bool_)
    at, _ = camera.project(places[deep])
    seen[deep] = np.linalg.norm(at - pixels[deep], axis=-1) < MAX_DISTANCE
    return seen


def _in_front(camera: Camera, places: Array) -> NDArray[np.bool_]:
    """Which of `places` [m, 3] are in front of the camera."""
    ahead: NDArray[np.bool_] = (places - camera.center) @ camera.forward > 0
    return ahead
