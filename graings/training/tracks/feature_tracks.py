"""Feature tracks: motion tracks of what crosses a video, found before training from the features of its frames.

Points are carried from frame to frame by the rigid motion of the moving features around them. The depth of a feature is
that of its surroundings, so a track may be too near or too far; along the way of the camera it looks right.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from graings.capture.capture import Capture, Frame
from graings.capture.images import ImageStore
from graings.config import TrainConfig
from graings.random import RandomStreams
from graings.training.curriculum.missing_motion import check_iteration
from graings.training.tracks.motion_tracks import RESTING, TRACKED, MotionTracks, subsampled
from graings.training.tracks.moving_features import FeatureMotion, MovingFeatures, Points, shift_at_rest

# A video has at least so many frames, and points at rest move by less than this part of the image from one to the next.
MIN_FRAMES: Final = 8
MAX_FRAMES: Final = 120
MAX_REST_SHIFT: Final = 0.1

# Something moves through the clip if this share of the pairs of frames has so many moving features. First only PROBES
# pairs are looked at.
MIN_MOVING: Final = 40
MIN_SHARE: Final = 0.8
PROBES: Final = 6

# Features whose common rigid motion moves a point, and rounds in which those that do not fit lose their weight.
AROUND: Final = 24
ROUNDS: Final = 4

# A point goes with the features if one is nearer than this part of the size of all of them together.
NEAR: Final = 0.25

# Points that are followed at once before TRACKED of them are chosen.
GATHERED: Final = 1500

# Tracks are checked by features that are matched over LEAP frames at once: the median distance to them in the image
# must be below this part of the way that they have come.
LEAP: Final = 4
MAX_MISFIT: Final = 0.25


def feature_tracks(capture: Capture, images: ImageStore, config: TrainConfig) -> MotionTracks | None:
    """Tracks of what moves in a video; None where nothing moves far, or where it cannot be followed.

    The capture needs a point cloud, and pycolmap finds the features. None too without DeformNet, with a time window
    that is configured, and in a run too short for a restart.
    """
    left_out = config.scene.single_mlp or config.scene.deformation == "none" or config.time_window is not None
    frames = None if left_out or check_iteration(config) is None else _video(capture)
    if frames is None or capture.points is None:
        return None
    generator = RandomStreams(config.seed)["tracks"]
    moving = MovingFeatures(frames, images, capture.points.positions)
    pairs = list(pairwise(range(len(frames))))
    probes = [pairs[index] for index in np.linspace(0, len(pairs) - 1, PROBES).round().astype(int)]
    try:
        if not _enough([moving.between(*pair) for pair in probes]):
            return None
    except ImportError:
        return None  # without the extra graings[colmap]
    motions, leaps = _all_motions(moving, len(frames))
    if not _enough(motions) or not _leaps_agree(moving, motions, leaps):
        return None
    middle = len(frames) // 2
    points = _gathered(motions, middle, generator)
    rest = torch.from_numpy(capture.points.positions).float()
    order = torch.randperm(len(rest), generator=generator)[:RESTING]
    return MotionTracks(
        torch.from_numpy(points).float(),
        torch.tensor([frame.time for frame in frames], dtype=torch.float32),
        torch.from_numpy(_followed(points, motions, middle)).float(),
        rest[order],
    )


def _video(capture: Capture) -> list[Frame] | None:
    """Frames in the order of their times if they are those of one moving camera, else None."""
    if capture.points is None or len(capture.train) < MIN_FRAMES:
        return None
    frames = sorted(capture.train, key=lambda frame: frame.time)
    chosen = [frames[index] for index in np.linspace(0, len(frames) - 1, min(len(frames), MAX_FRAMES)).astype(int)]
    pairs = list(pairwise(chosen))
    if any(one.time == other.time for one, other in pairs):
        return None
    shifts = [shift_at_rest(one.camera, other.camera, capture.points.positions) for one, other in pairs]
    return chosen if np.median(shifts) < MAX_REST_SHIFT else None


def _enough(motions: Sequence[FeatureMotion]) -> bool:
    return bool(np.mean([len(motion.start) >= MIN_MOVING for motion in motions]) >= MIN_SHARE)


def _all_motions(moving: MovingFeatures, count: int) -> tuple[list[FeatureMotion], dict[int, FeatureMotion]]:
    """The motions from each of `count` frames to the next, and some over `LEAP` frames, by their first frame."""
    motions, leaps = [], {}
    first = set(np.linspace(0, count - 1 - LEAP, PROBES).astype(int).tolist())
    for frame in range(count - 1):
        motions.append(moving.between(frame, frame + 1))
        if (start := frame + 1 - LEAP) in first:
            leaps[start] = moving.between(start, frame + 1)
    return motions, leaps


def _leaps_agree(moving: MovingFeatures, motions: Sequence[FeatureMotion], leaps: Mapping[int, FeatureMotion]) -> bool:
    """Whether points that are carried from frame to frame arrive where features are matched over several at once."""
    misses, ways = [], []
    for start, leap in leaps.items():
        carried = _steps(leap.start, motions[start : start + LEAP])[-1]
        misses.append(moving.error(start + LEAP, carried, leap.end))
        ways.append(moving.error(start + LEAP, leap.start, leap.end))
    miss, way = np.concatenate(misses), np.concatenate(ways)
    return len(miss) >= MIN_MOVING and bool(np.median(miss) < MAX_MISFIT * np.median(way))


def _gathered(motions: Sequence[FeatureMotion], frame: int, generator: torch.Generator) -> Points:
    """At most `TRACKED` moving features of all frames, carried to `frame`."""
    before, after = np.empty((2, 0, 3))
    for motion in motions[:frame]:
        before = _steps(subsampled(np.concatenate([before, motion.start]), GATHERED, generator), [motion])[-1]
    for motion in reversed([motion.reversed() for motion in motions[frame:]]):
        after = _steps(subsampled(np.concatenate([after, motion.start]), GATHERED, generator), [motion])[-1]
    return subsampled(_not_alone(np.concatenate([before, after])), TRACKED, generator)


def _followed(points: Points, motions: Sequence[FeatureMotion], frame: int) -> Points:
    """Positions [T, M, 3] in all frames of points [M, 3] in `frame`."""
    earlier = _steps(points, [motion.reversed() for motion in reversed(motions[:frame])])
    return np.stack([*reversed(earlier), points, *_steps(points, motions[frame:])])


def _steps(points: Points, motions: Sequence[FeatureMotion]) -> list[Points]:
    """Positions of points [M, 3] after each motion. Where no feature is near, a point goes on as it went before."""
    found, last = [], np.zeros_like(points)
    for motion in motions:
        moved = points + last
        if len(motion.start) >= AROUND and len(points):
            apart, around = _nearest(points, motion.start, AROUND)
            size = np.sqrt(((motion.start - motion.start.mean(0)) ** 2).sum(-1).mean())
            near = apart[:, 0] < NEAR * size
            moved[near] = _rigidly(points[near], motion.start[around[near]], motion.end[around[near]])
        last, points = moved - points, moved
        found.append(points)
    return found


def _rigidly(points: Points, start: Points, end: Points) -> Points:
    """Each of points [M, 3] after the rigid motion that takes its `start` [M, K, 3] nearest to `end`, robustly."""
    weights = np.ones(start.shape[:2])
    for _ in range(ROUNDS):
        share = (weights / weights.sum(1, keepdims=True))[..., None]
        a, b = (share * start).sum(1), (share * end).sum(1)
        left, _, right = np.linalg.svd(np.einsum("mki,mkj->mij", share * (start - a[:, None]), end - b[:, None]))
        flip = np.ones((len(points), 3))
        flip[:, 2] = np.sign(np.linalg.det(left @ right))
        turn = np.swapaxes((left * flip[:, None]) @ right, 1, 2)
        fitted = np.einsum("mij,mkj->mki", turn, start - a[:, None]) + b[:, None]
        apart = np.linalg.norm(fitted - end, axis=-1)
        weights = 1.0 / (1.0 + (apart / np.maximum(np.median(apart, axis=1, keepdims=True), 1e-12)) ** 2)
    moved: Points = np.einsum("mij,mj->mi", turn, points - a) + b
    return moved


def _nearest(points: Points, others: Points, count: int) -> tuple[Points, NDArray[np.int64]]:
    """Distances and indices [M, count] of the nearest of `others`."""
    found = torch.cdist(torch.from_numpy(points), torch.from_numpy(others)).topk(count, largest=False)
    return found.values.numpy(), found.indices.numpy()


def _not_alone(points: Points) -> Points:
    """Without points that are three times farther than usual from their neighbours."""
    apart = _nearest(points, points, min(len(points), 9))[0][:, -1]
    return points[apart <= 3 * np.median(apart)]
