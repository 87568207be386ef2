"""Moving features: image features of a video that go elsewhere than its camera explains.

The depth of a feature is taken from points at rest that are near it in the image: what moves usually stands on
something. A feature rests if its match in the next frame is where that depth and the cameras put it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.matching.features import extract, matches, reduced
from graings.matching.rays import directions, in_front

Points = NDArray[np.float64]

# Longer side of the images that are matched, in px. At 880 px as many features move, and it takes twice as long.
SIDE: Final = 640

# A feature moves if its match is farther from where it would be at rest than this part of the longer image side.
MIN_SHIFT: Final = 0.005

# Resting points whose median inverse depth a place of the image gets, and such places along the longer side.
NEAREST: Final = 8
PLACES: Final = 64
# Of more resting points a random sample gives the depths: they are compared with every place.
MAX_REST: Final = 10_000

# A feature belongs to something that moves if it moves like so many moving features around it, up to this part of
# their median displacement. Wrong matches do not.
AGREEING: Final = 8
MAX_DISAGREEMENT: Final = 0.5

# Frames whose features are kept, 2 MB each.
KEPT: Final = 6


@dataclass(frozen=True, slots=True, eq=False)
class FeatureMotion:
    """Points [M, 3] in one frame and where they are in another one, normalised units."""

    start: Points
    end: Points

    def reversed(self) -> FeatureMotion:
        """The way back."""
        return FeatureMotion(self.end, self.start)


class MovingFeatures:
    """What moves between frames of a video, given points [N, 3] at rest. Images are read when they are asked for.

    Frames are matched at the size of their files, at most `SIDE` px: at the size of training many features are lost.
    """

    def __init__(self, frames: Sequence[Frame], images: ImageStore, rest: Points) -> None:
        whole = [replace(frame, camera=frame.camera.resized(*frame.source_size)) for frame in frames]
        self.frames = [reduced(frame, SIDE) for frame in whole]
        self.rest = rest
        self._features = lru_cache(KEPT)(lambda frame: extract([self.frames[frame]], images)[0])
        sparse = rest if len(rest) <= MAX_REST else np.random.default_rng(0).choice(rest, MAX_REST, replace=False)
        self._depths = lru_cache(KEPT)(lambda frame: _depths(self.frames[frame].camera, sparse))

    def between(self, one: int, other: int) -> FeatureMotion:
        """The moving features that two frames share. Raises `ImportError` without pycolmap."""
        first, second = self._features(one), self._features(other)
        a, b = matches(first.descriptors, second.descriptors)
        start, end = self._places(one, first.pixels[a]), self._places(other, second.pixels[b])
        ahead = in_front(self.frames[other].camera, start) & np.isfinite(end).all(axis=1)
        start, end, pixels = start[ahead], end[ahead], second.pixels[b[ahead]]
        shift = np.linalg.norm(self.frames[other].camera.project(start)[0] - pixels, axis=1)
        moves = shift > MIN_SHIFT * self._side(other)
        return _agreeing(start[moves], end[moves])

    def error(self, frame: int, places: Points, truth: Points) -> Points:
        """Distances [M] in the image between points, as parts of its longer side."""
        camera = self.frames[frame].camera
        apart: Points = np.linalg.norm(camera.project(places)[0] - camera.project(truth)[0], axis=1)
        return apart / self._side(frame)

    def _side(self, frame: int) -> int:
        return max(self.frames[frame].camera.width, self.frames[frame].camera.height)

    def _places(self, frame: int, pixels: Points) -> Points:
        """Points [M, 3] behind `pixels` [M, 2], at the depth of the points at rest around them."""
        camera, depths = self.frames[frame].camera, self._depths(frame)
        step = self._side(frame) / PLACES
        columns, rows = (pixels / step).astype(np.intp).clip(0, np.array(depths.shape)[::-1] - 1).T
        towards = directions(camera, pixels)
        places: Points = camera.center + towards * depths[rows, columns, None]
        return places


def shift_at_rest(one: Camera, other: Camera, rest: Points) -> float:
    """Median way of points [N, 3] between two images, as a part of the longer side; infinite if none are in both."""
    ahead = rest[in_front(one, rest) & in_front(other, rest)]
    before, after = one.project(ahead)[0], other.project(ahead)[0]
    shown = _within(one, before) & _within(other, after)
    side = max(one.width, one.height)
    return float(np.median(np.linalg.norm(before - after, axis=1)[shown])) / side if shown.any() else np.inf


def _within(camera: Camera, pixels: Points) -> NDArray[np.bool_]:
    return np.asarray(((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1))


def _depths(camera: Camera, rest: Points) -> Points:
    """Depths [h, w] of square places of the image, each from the points nearest to it; NaN if none is in front."""
    step = max(camera.width, camera.height) / PLACES
    ahead = rest[in_front(camera, rest)]
    pixels = camera.project(ahead)[0]
    inverse = 1.0 / ((ahead - camera.center) @ camera.forward)
    rows, columns = (np.arange(np.ceil(side / step)) + 0.5 for side in (camera.height, camera.width))
    places = np.stack(np.meshgrid(columns * step, rows * step), axis=-1)
    if len(ahead) == 0:
        return np.full(places.shape[:2], np.nan)
    apart = torch.cdist(torch.from_numpy(places.reshape(-1, 2)), torch.from_numpy(pixels))
    nearest = apart.topk(min(NEAREST, len(ahead)), largest=False).indices.numpy()
    depths: Points = (1.0 / np.median(inverse[nearest], axis=1)).reshape(places.shape[:2])
    return depths


def _agreeing(start: Points, end: Points) -> FeatureMotion:
    if len(start) <= AGREEING:
        return FeatureMotion(start[:0], end[:0])
    apart = torch.cdist(torch.from_numpy(start), torch.from_numpy(start)).fill_diagonal_(torch.inf)
    around = apart.topk(AGREEING, largest=False).indices.numpy()
    moves = end - start
    usual = np.median(moves[around], axis=1)
    kept = np.linalg.norm(moves - usual, axis=1) < MAX_DISAGREEMENT * np.linalg.norm(usual, axis=1)
    return FeatureMotion(start[kept], end[kept])
