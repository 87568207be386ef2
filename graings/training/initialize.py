"""First anchors: from the capture's point cloud, or from random points that the masks allow (decision 3).

Knows nothing of networks' training; makes a scene that is ready for the first step.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from graings.camera import Camera
from graings.capture.capture import Capture, Frame
from graings.capture.images import ImageStore
from graings.config import TrainConfig
from graings.errors import CaptureError
from graings.scene.scaffold import Scaffold
from graings.scene.scene import Scene
from graings.training.density import voxel_keys
from graings.training.streams import Streams
from graings.training.time_window import TimeWindow

FEATURE_STD = 0.1

# The finest cell in pixel footprints at the scene's centre: 0.005 units on D-NeRF at 400 px, 0.0025 at 800.
VOXEL_PER_PIXEL = 0.7

# Voting needs enough views to outvote a few wrong masks, not all of them.
CARVING_VIEWS = 60

# A mask is dilated by this many pixels, so that a thin moving part still counts as hit.
MASK_MARGIN = 2

# With fewer carved points than this the vote has failed (masks that never overlap) and is not used.
MIN_CARVED = 100

NEIGHBOURS = 3


def make_scene(capture: Capture, images: ImageStore, config: TrainConfig, streams: Streams) -> tuple[Scene, float]:
    """A scene ready for the first step, and the voxel size (normalised units)."""
    voxel = config.init.voxel_size or VOXEL_PER_PIXEL * pixel_footprint(capture)
    points = first_points(capture, images, config, streams)
    cells = torch.unique(voxel_keys(torch.from_numpy(points), voxel), dim=0)
    anchors = cells.double() * voxel
    extent = float(torch.quantile(anchors.norm(dim=-1).float(), 0.99)) or 1.0
    spacing = neighbour_distance(anchors.numpy()).clip(1e-4 * extent, 0.1 * extent)
    generator = streams["init"]
    count, scene = len(anchors), config.scene
    scaffold = Scaffold(
        anchors=anchors.float(),
        log_scales=torch.from_numpy(np.log(spacing)).float().unsqueeze(-1).repeat(1, 3),
        features=torch.randn(count, scene.feature_dim, generator=generator) * FEATURE_STD,
        offsets=torch.randn(count, scene.children, 3, generator=generator) * config.init.offset_std,
    )
    return Scene(scene, scaffold, extent=extent, initial_opacity=config.init.opacity, seed=config.seed), voxel


def pixel_footprint(capture: Capture) -> float:
    """Median size of one training pixel at the scene's centre, normalised units."""
    sizes = [abs(float(np.linalg.norm(frame.camera.center))) / frame.camera.fx for frame in capture.train]
    return max(float(np.median(sizes)), 1e-6)


def first_points(capture: Capture, images: ImageStore, config: TrainConfig, streams: Streams) -> NDArray[np.float64]:
    """Positions [M, 3] to start from: the capture's cloud, else carved random points."""
    generator = streams["init.points"]
    if capture.points is not None:
        points = capture.points.positions
        if len(points) > config.init.max_points:
            chosen = torch.randperm(len(points), generator=generator)[: config.init.max_points]
            points = points[np.sort(chosen.numpy())]
        return points
    half = content_half_size(capture)
    cube = (torch.rand(config.init.points, 3, generator=generator, dtype=torch.float64).numpy() * 2 - 1) * half
    if not capture.has_alpha or config.init.carve_vote == 0:
        return cube
    window = TimeWindow(config, [frame.time for frame in capture.train])
    order = torch.randperm(len(capture.train), generator=generator)
    order = order[[window.has(view, 0) for view in order.tolist()]][:CARVING_VIEWS]
    votes = np.zeros(len(cube), dtype=np.int64)
    seen = np.zeros(len(cube), dtype=np.int64)
    empty = True
    for index in sorted(order.tolist()):
        frame = capture.train[index]
        inside, hit, any_mask = _vote(cube, frame, images)
        seen += inside
        votes += hit
        empty &= not any_mask
    if empty:
        raise CaptureError(
            "every mask is empty: there is nothing to see in any training image",
            file=capture.train[0].name,
            field="alpha",
            remedy="Check the alpha channel of the images, or remove it.",
        )
    # A point that no view sees is kept out too: nothing could ever train it.
    kept = cube[(seen > 0) & (votes >= config.init.carve_vote * np.maximum(seen, 1))]
    return kept if len(kept) >= MIN_CARVED else cube


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


def _vote(
    points: NDArray[np.float64], frame: Frame, images: ImageStore
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], bool]:
    """(in view, on the dilated mask) for each point, and whether the mask has anything."""
    columns, rows, inside = project(points, frame.camera)
    alpha = images.alpha(frame)
    if alpha is None:
        return inside, inside, True
    mask = torch.from_numpy(np.ascontiguousarray(alpha > 0.5)).float()[None, None]
    dilated = torch.nn.functional.max_pool2d(mask, 2 * MASK_MARGIN + 1, stride=1, padding=MASK_MARGIN)[0, 0].numpy() > 0
    hit = np.zeros(len(points), dtype=np.bool_)
    hit[inside] = dilated[rows[inside], columns[inside]]
    return inside, hit, bool(mask.any())


def project(
    points: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Pixel column and row of each point, and whether it is in front of the camera and inside the image."""
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = np.maximum(local[:, 2], 1e-9)
    u = camera.fx * local[:, 0] / depth + camera.cx
    v = camera.fy * local[:, 1] / depth + camera.cy
    inside = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    columns = np.where(inside, u, 0).astype(np.int64)
    rows = np.where(inside, v, 0).astype(np.int64)
    return columns, rows, inside


def neighbour_distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean squared distance to the three nearest neighbours, [M]; 1 for a single point."""
    count = len(points)
    if count < 2:
        return np.ones(count)
    k = min(NEIGHBOURS, count - 1)
    tensor = torch.from_numpy(points)
    result = np.empty(count)
    chunk = max(1, 20_000_000 // count)
    for start in range(0, count, chunk):
        distances = torch.cdist(tensor[start : start + chunk], tensor, compute_mode="donot_use_mm_for_euclid_dist")
        nearest = distances.topk(k + 1, dim=-1, largest=False).values[:, 1:]
        result[start : start + chunk] = nearest.square().mean(-1).sqrt().numpy()
    return result
