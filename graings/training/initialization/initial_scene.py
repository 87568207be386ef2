"""The initial scene: anchors from the capture's point cloud, or from random points within the visual hull.

Where the masks cover nearly all of the images they do not constrain positions: points are then triangulated from pairs
of images. The synthetic data sets of the paper have no point cloud, and it does not say what replaces one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from graings.camera.sampling_rate import SamplingRate
from graings.capture.capture import Capture
from graings.capture.images import ImageStore
from graings.config import TrainConfig
from graings.random import RandomStreams
from graings.report.start_events import PointsInitialized
from graings.scene.scaffold import Scaffold
from graings.scene.scene import Scene
from graings.training.curriculum.time_window import TimeWindow
from graings.training.density.budget import affordable_anchors, most_anchors
from graings.training.density.growth import voxel_keys
from graings.training.initialization.neighbours import neighbour_distance
from graings.training.initialization.triangulation import triangulate
from graings.training.initialization.visual_hull import (
    MIN_COVERAGE,
    MIN_POINTS,
    MIN_VIEWS,
    WINDOW_FRACTIONS,
    MaskedFrame,
    check_not_empty,
    coverage,
    masked,
    not_masked,
    visual_hull,
)
from graings.training.tracks.motion_tracks import MotionTracks

FEATURE_STD = 0.1

# Size of the finest voxel in pixels of the reference sampling rate: 0.005 units of D-NeRF at 400 px, 0.0025 at 800.
VOXEL_PER_PIXEL = 0.7

# Number of views that vote: enough to outvote a few wrong masks.
CARVING_VIEWS = 60

# Masks that cover more than this share of the pixels do not constrain positions. Objects on a background cover a third
# at most (bouncingballs), a room nearly everything.
FILLED = 0.7


@dataclass(frozen=True, slots=True, eq=False)
class InitialScene:
    """A scene ready for the first step."""

    scene: Scene
    voxel_size: float  # normalised units
    time_window: float  # share of the clip that training begins with
    notes: tuple[PointsInitialized, ...]  # how the points were chosen, where masks did not


@dataclass(frozen=True, slots=True, eq=False)
class InitialPoints:
    """Positions [M, 3] to start from, the `time_window` they stand for, and how they were chosen."""

    positions: NDArray[np.float64]
    time_window: float
    notes: tuple[PointsInitialized, ...] = ()


def make_scene(
    capture: Capture,
    images: ImageStore,
    config: TrainConfig,
    streams: RandomStreams,
    tracks: MotionTracks | None = None,
) -> InitialScene:
    """A scene of the first anchors, on the points of `tracks` too.

    Raises `CaptureError` where no image shows anything.
    """
    first = initial_points(capture, images, config, streams)
    cameras = [frame.camera for frame in capture.train]
    places = torch.from_numpy(first.positions)
    if tracks is not None:
        places = torch.cat([places, tracks.points.double()])
    voxel = config.init.voxel_size or VOXEL_PER_PIXEL / SamplingRate.of(cameras, content_extent(places)).reference
    anchors = torch.unique(voxel_keys(places, voxel), dim=0).double() * voxel
    extent = content_extent(anchors)  # of anchors, not points: dense parts of a cloud must not dominate
    spacing = neighbour_distance(anchors.numpy()).clip(1e-4 * extent, 0.1 * extent)
    generator = streams["init"]
    count, scene = len(anchors), config.scene
    scaffold = Scaffold(
        anchors=anchors.float(),
        log_scales=torch.from_numpy(np.log(spacing)).float().unsqueeze(-1).repeat(1, 3),
        features=torch.randn(count, scene.feature_dim, generator=generator) * FEATURE_STD,
        offsets=torch.randn(count, scene.children, 3, generator=generator) * config.init.offset_std,
        opacity_offsets=torch.zeros(count, scene.children) if scene.child_opacity_offsets else None,
    )
    made = Scene(
        scene,
        scaffold,
        extent=extent,
        sampling=SamplingRate.of(cameras, extent),
        initial_opacity=config.init.opacity,
        seed=config.seed,
    )
    return InitialScene(made, voxel, first.time_window, first.notes)


def content_extent(points: Tensor) -> float:
    """Radius about the origin that holds all but a hundredth of `points` [M, 3], normalised units; 1 where it is 0."""
    return float(torch.quantile(points.norm(dim=-1).float(), 0.99)) or 1.0


def initial_points(capture: Capture, images: ImageStore, config: TrainConfig, streams: RandomStreams) -> InitialPoints:
    """The capture's point cloud, or else random points within the visual hull, or points triangulated from the images.

    The time window is as configured, or else the widest in which the points still cover the masks.
    """
    generator, window = streams["init.points"], config.time_window or 1.0
    affordable = affordable_anchors(config.scene, config.batch, config.density.memory_mb)
    most = min(config.init.max_points, affordable)
    # Points on surfaces stay: more than the anchor budget would leave no room for growth. Points of a visual hull lie
    # inside of objects, and most of them are soon pruned.
    surface_limit = min(most, most_anchors(config))
    if capture.points is not None:
        shown = not_masked(capture.points.positions, capture.train, images)
        if len(shown):
            return InitialPoints(_subsampled(shown, surface_limit, generator), window)
    half = content_half_size(capture)
    cube = (torch.rand(config.init.points, 3, generator=generator, dtype=torch.float64).numpy() * 2 - 1) * half
    if config.init.min_mask_fraction == 0:
        return InitialPoints(_subsampled(cube, most, generator), window)
    order = torch.randperm(len(capture.train), generator=generator).tolist()
    whole = _masked_views(capture, images, config, order, 1.0)
    check_not_empty(whole)  # within a part of the clip all objects may be out of view
    notes: tuple[PointsInitialized, ...] = ()
    filled = [view.filled for view in whole if view.filled is not None]
    if filled and np.mean(filled) > FILLED:
        places, note = _triangulated(capture, images)
        notes = (note,)
        if places is not None:
            return InitialPoints(_subsampled(places, surface_limit, generator), window, notes)
    hull = partial(_within_hull, cube, half, order, whole, capture, images, config)
    found, within = hull()
    if found is None and within > 0:
        found, _ = hull(generator)
    if found is None:
        notes = (*notes, PointsInitialized(iteration=0, source="random", within_masks=within))
    inside, window = found or (cube, window)
    return InitialPoints(_subsampled(inside, most, generator), window, notes)


def _triangulated(capture: Capture, images: ImageStore) -> tuple[NDArray[np.float64] | None, PointsInitialized]:
    """Points [M, 3] triangulated from pairs of images, None where there are too few; and the event for the report."""
    try:
        found = triangulate(capture.train, images)
    except ImportError:
        return None, PointsInitialized(iteration=0, source="random", triangulated=None)
    count = len(found.points)
    if count < MIN_POINTS:
        return None, PointsInitialized(iteration=0, source="random", triangulated=count)
    event = PointsInitialized(iteration=0, source="triangulation", triangulated=count, interpolated=len(found.filled))
    return np.concatenate([found.points, found.filled]), event


def _masked_views(
    capture: Capture, images: ImageStore, config: TrainConfig, order: Sequence[int], share: float
) -> list[MaskedFrame]:
    """Masks of the first views in `order` among those in the middle `share` of the clip."""
    window = TimeWindow(config, [frame.time for frame in capture.train], share)
    chosen = sorted([view for view in order if window.has(view, 0)][:CARVING_VIEWS])
    return masked([capture.train[view] for view in chosen], images, config.capture.background_rgb())


def _subsampled(points: NDArray[np.float64], most: int, generator: torch.Generator) -> NDArray[np.float64]:
    """At most `most` of `points` [M, 3], a random sample in their order."""
    if len(points) <= most:
        return points
    return points[np.sort(torch.randperm(len(points), generator=generator)[:most].numpy())]


def _within_hull(
    cube: NDArray[np.float64],
    half: float,
    order: Sequence[int],
    whole: Sequence[MaskedFrame],
    capture: Capture,
    images: ImageStore,
    config: TrainConfig,
    closer: torch.Generator | None = None,
) -> tuple[tuple[NDArray[np.float64], float] | None, int]:
    """The points of `cube`, of half-size `half`, within the visual hull, and the share of the clip that it is made of.

    None in their place where they are too few, and how many there were at most. `whole` are the masks of views of the
    whole clip; for a part of it the first views in `order` are used. With `closer` points are tried again in the box
    around those that are too few: the objects are small.
    """
    best, most, found = None, -1.0, 0
    for share in WINDOW_FRACTIONS if config.time_window is None else [config.time_window]:
        views = whole if share == 1 else _masked_views(capture, images, config, order, share)
        if config.time_window is None and share < 1 and len(views) < MIN_VIEWS:
            break
        spacing = 2 * half / len(cube) ** (1 / 3)
        kept = visual_hull(cube, views, config.init.min_mask_fraction, _cells(half, spacing))
        found = max(found, len(kept))
        if closer is not None and 0 < len(kept) < MIN_POINTS:
            low, high = kept.min(0) - spacing, kept.max(0) + spacing
            box = low + (high - low) * torch.rand(cube.shape, generator=closer, dtype=torch.float64).numpy()
            spacing = float(np.prod(high - low) / len(box)) ** (1 / 3)
            kept = visual_hull(box, views, config.init.min_mask_fraction, _cells(half, spacing))
        if len(kept) < MIN_POINTS:
            continue
        covered = coverage(kept, views, _cells(half, spacing))
        if closer is not None and covered < MIN_COVERAGE:
            continue  # where rays of cameras that do not fit happen to meet there are points as well
        if covered > most:
            best, most = (kept, share), covered
        if covered >= MIN_COVERAGE:
            break
    return best, found


def _cells(half: float, spacing: float) -> int:
    """Cells of the longer image side, each a little smaller than the projected `spacing` of points."""
    return math.ceil(1.25 * 2 * half / spacing)


def content_half_size(capture: Capture) -> float:
    """Half-size of the cube for random points: what the median camera sees at the scene's centre.

    For D-NeRF (distance 4, 40 degrees) this is 1.44 units, close to the customary 1.3.
    """
    half = [
        float(np.linalg.norm(frame.camera.center))
        * 0.5
        * min(frame.camera.width / frame.camera.fx, frame.camera.height / frame.camera.fy)
        for frame in capture.train
    ]
    return max(float(np.median(half)), 1e-3)
