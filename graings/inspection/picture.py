"""A picture of some cameras: their images with the bounds of the scene drawn in, and plans of all cameras."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.capture import Capture
from graings.capture.images import ImageStore
from graings.report.figure_files import INK, NOTE, WARNING, png, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

SHOWN: Final = 4
MAX_POINTS: Final = 2000
# Pairs of corners of a box that differ in one bit: its twelve edges.
EDGES: Final = tuple((a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b).bit_count() == 1)
NEAR: Final = 1e-2  # edges are cut at this depth, normalised


def draw_cameras(capture: Capture, images: ImageStore, bounds: tuple[Array, Array]) -> bytes:
    """PNG of four training images, spread over the clip, and two plans of the cameras; `bounds` is a normalised box."""
    from matplotlib.figure import Figure  # takes 0.4 s, which a command that draws nothing should not wait for

    corners = np.array([[bounds[bit][axis] for axis, bit in enumerate(bits)] for bits in product((0, 1), repeat=3)])
    frames = sorted(capture.train, key=lambda frame: (frame.time, frame.name))
    chosen = [frames[index] for index in np.unique(np.linspace(0, len(frames) - 1, SHOWN).round().astype(int))]
    points = np.zeros((0, 3)) if capture.points is None else capture.points.positions
    points = points[:: max(1, len(points) // MAX_POINTS)]
    with style():
        figure = Figure(figsize=(10, 6.4))
        grid = figure.add_gridspec(2, 4, height_ratios=(1, 1.3), left=0.03, right=0.98, bottom=0.06, top=0.95)
        for column, frame in enumerate(chosen):
            axes = figure.add_subplot(grid[0, column])
            _image(axes, images.rgb(frame), images.valid(frame), frame.camera, corners, points)
            axes.set_title(f"{frame.name.rpartition('/')[2]}, t = {frame.time:.2f}", color=INK, fontsize=8)
        across, along = _horizontal(np.asarray(capture.units.up))
        plans = (("from above", across, along), ("from the side", across, np.asarray(capture.units.up)))
        for index, (title, x, y) in enumerate(plans):
            axes = figure.add_subplot(grid[1, 2 * index : 2 * index + 2])
            _plan(axes, np.stack([x, y]), [frame.camera for frame in frames], corners, points)
            axes.set_title(f"{title}: cameras and where they look, the box of the scene", color=INK, fontsize=8)
        return png(figure)


def _image(axes: Axes, image: Any, valid: Any, camera: Camera, corners: Array, points: Array) -> None:
    shown = (
        image
        if valid is None
        else np.where(valid[..., None], image, 0.5 * image + np.array([0.5, 0.0, 0.0], np.float32))
    )
    axes.imshow(shown, extent=(0, camera.width, camera.height, 0), interpolation="nearest")
    for a, b in EDGES:
        line = _visible(camera, corners[a], corners[b])
        if line is not None:
            axes.plot(line[:, 0], line[:, 1], color=WARNING, linewidth=1.0)
    if len(points):
        pixels, depths = camera.project(points)
        axes.plot(*pixels[depths > NEAR].T, ".", color=INK, markersize=1.0, alpha=0.6)
    axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), xticks=(), yticks=())
    axes.grid(visible=False)


def _visible(camera: Camera, a: Array, b: Array) -> Array | None:
    """The projection [2, 2] of the part of an edge that is in front of the camera; None without one."""
    ends = np.stack([a, b])
    depths = (ends - camera.center) @ camera.forward
    if (depths <= NEAR).all():
        return None
    if (depths <= NEAR).any():
        behind = int(depths.argmin())
        share = (NEAR - depths[behind]) / (depths[1 - behind] - depths[behind])
        ends[behind] += share * (ends[1 - behind] - ends[behind])
    return camera.project(ends)[0]


def _plan(axes: Axes, plane: Array, cameras: list[Camera], corners: Array, points: Array) -> None:
    """Cameras, box and points on the `plane` [2, 3]."""
    if len(points):
        axes.plot(*(plane @ points.T), ".", color=NOTE, markersize=1.0, alpha=0.5)
    for a, b in EDGES:
        axes.plot(*(plane @ corners[[a, b]].T), color=WARNING, linewidth=1.0)
    centers = np.stack([camera.center for camera in cameras])
    reach = 0.15 * max(float(np.ptp(centers, axis=0).max()), float(np.ptp(corners, axis=0).max()))
    ends = centers + reach * np.stack([camera.forward for camera in cameras])
    for begin, end in zip((plane @ centers.T).T, (plane @ ends.T).T, strict=True):
        axes.plot([begin[0], end[0]], [begin[1], end[1]], color=INK, linewidth=0.6)
    axes.plot(*(plane @ centers.T), "o", color=INK, markersize=2.5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xticks=(), yticks=())
    axes.grid(visible=False)


def _horizontal(up: Array) -> tuple[Array, Array]:
    """Two unit axes [3] perpendicular to `up` and each other."""
    across = np.cross(np.eye(3)[int(np.abs(up).argmin())], up)
    across /= np.linalg.norm(across)
    return across, np.cross(up, across)
