"""The visual hull: which random points lie within the masks, and for how long a part of the clip.

A point is inside if it projects into the masks of most views that see it. With large motion no point is, if the whole
clip is taken as one instant; within a short part of the clip some are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.background import COLOR_TOLERANCE
from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.errors import CaptureError

# Mask fractions that are tried before the configured minimum: static objects reach the first.
STRICTER_FRACTIONS: Final = (0.95, 0.9, 0.85, 0.8, 0.75, 0.7, 0.65)

# Masks are dilated by this many pixels, so that thin moving parts are not missed.
MASK_MARGIN: Final = 2

# With fewer points than this the visual hull has failed.
MIN_POINTS: Final = 100

# Least share of each connected component of a mask that has to lie within about one spacing of a point. Of the tested
# clips, those that train well as a whole have 0.74 and more, two in which a moving ball is missing 0.42 and less.
MIN_COVERAGE: Final = 0.6

# This share of the views is ignored: a few wrong masks, or objects seen briefly.
OUTLIER_FRACTION: Final = 0.05

# Connected components below this share of the mask are ignored.
MIN_COMPONENT: Final = 0.01

# Shares of the clip that are tried, and the fewest views that each needs.
WINDOW_FRACTIONS: Final = (1.0, 0.5, 0.25, 0.1)
MIN_VIEWS: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class MaskedFrame:
    """A frame, its silhouette `mask` [H, W] (opaque, not of the background colour), and whether any pixel is opaque.

    `valid` [H, W] are the pixels that the capture does not mask: others neither vote nor have to be covered.
    """

    frame: Frame
    mask: NDArray[np.bool_]
    opaque: bool
    valid: NDArray[np.bool_] | None = None

    @property
    def filled(self) -> float | None:
        """Share of the valid pixels that the mask fills; None where no pixel is valid."""
        if self.valid is None:
            return float(self.mask.mean())
        return float(self.mask[self.valid].mean()) if self.valid.any() else None


def masked(frames: Sequence[Frame], images: ImageStore, background: Sequence[float]) -> list[MaskedFrame]:
    """The masks of `frames`: opaque pixels that do not have the background colour."""
    found = []
    for frame in frames:
        alpha = images.alpha(frame)
        differs = np.abs(images.rgb(frame) - np.asarray(background, np.float32)).max(axis=-1) > COLOR_TOLERANCE
        opaque = np.ones_like(differs) if alpha is None else alpha > 0.5
        valid = images.valid(frame)
        seen = opaque & differs if valid is None else opaque & differs & valid
        found.append(MaskedFrame(frame, seen, bool(opaque.any()), valid))
    return found


def not_masked(points: NDArray[np.float64], frames: Sequence[Frame], images: ImageStore) -> NDArray[np.float64]:
    """Those of `points` [M, 3] that most of the `frames` that see them do not mask; points that none sees stay."""
    if all(frame.mask_path is None for frame in frames):
        return points
    seen, shown = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for frame in frames:
        columns, rows, inside = whole_pixels(points, frame.camera)
        valid = images.valid(frame)
        seen += inside
        shown += inside if valid is None else inside & valid[rows, columns]
    kept: NDArray[np.float64] = points[2 * shown >= seen]
    return kept


def check_not_empty(views: Sequence[MaskedFrame]) -> None:
    """Raise `CaptureError` where all of `views` are transparent everywhere."""
    if not any(view.opaque for view in views):
        raise CaptureError(
            "every mask is empty: all training images are transparent",
            file=views[0].frame.name,
            field="alpha",
            remedy="Check the alpha channel of the images, or remove it.",
        )


def visual_hull(
    points: NDArray[np.float64], views: Sequence[MaskedFrame], vote: float, cells: int
) -> NDArray[np.float64]:
    """Those of `points` [M, 3] within the visual hull, and as few as cover the masks.

    A point is inside if it projects into the dilated mask of at least a share `vote` of the views that see it. With
    motion that share has to be low, and the hull of static objects is then too large: a plate seen from above becomes a
    double cone. So points within nearly all masks come first, and points within fewer are added only where the masks of
    `OUTLIER_FRACTION` of the views or more are not covered yet, in cells of which `cells` fit the longer image side.
    """
    share = _mask_fractions(points, views)
    points, share = points[share >= vote], share[share >= vote]
    seen = [_Cells.of(points, view, cells) for view in views]
    kept = share >= STRICTER_FRACTIONS[0]
    for least in (*[level for level in STRICTER_FRACTIONS[1:] if level > vote], vote):
        missed = np.zeros(len(points), np.int64)
        for view in seen:
            missed += view.at(~view.near(kept) & (view.mask_pixels > 0))
        kept |= (share >= least) & (missed >= OUTLIER_FRACTION * len(views))
    few: NDArray[np.float64] = points[kept]
    return few if len(few) >= MIN_POINTS else points


def _mask_fractions(points: NDArray[np.float64], views: Sequence[MaskedFrame]) -> NDArray[np.float64]:
    """For each point, the share of the views that see it in whose dilated mask it lies; -1 where no view does."""
    votes, seen = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for view in views:
        columns, rows, inside = whole_pixels(points, view.frame.camera)
        mask = dilated(view.mask, MASK_MARGIN)
        if view.valid is not None:
            inside &= view.valid[rows, columns]
        seen += inside
        votes[inside] += mask[rows[inside], columns[inside]]
    return np.where(seen > 0, votes / np.maximum(seen, 1), -1.0)


def coverage(points: NDArray[np.float64], views: Sequence[MaskedFrame], cells: int) -> float:
    """Covered share of the least covered connected component of the masks, as a low quantile over `views`.

    A cell is covered if a point projects into it or a neighbour. A component without points is an object that growth
    would not reach. `points` [M, 3] are in normalised units; `cells` fit the longer image side. 1 where all masks are
    empty.
    """
    shares = []
    for view in views:
        if not view.mask.any():
            continue
        seen = _Cells.of(points, view, cells)
        components = _components(seen.mask_pixels > 0).ravel()
        whole = np.bincount(components, seen.mask_pixels.ravel())
        covered = np.bincount(
            components, np.where(seen.near(np.ones(len(points), np.bool_)), seen.mask_pixels, 0).ravel()
        )
        counts = whole >= min(MIN_COMPONENT * whole.sum(), whole.max())
        shares.append(float((covered[counts] / whole[counts]).min()))
    return float(np.quantile(shares, OUTLIER_FRACTION)) if shares else 1.0


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """A view in cells of several pixels: mask pixels per cell, [H, W], and the cell that each point projects into."""

    mask_pixels: NDArray[np.int64]
    cell: NDArray[np.int32]  # row-major; meaningless for points outside the image
    inside: NDArray[np.bool_]

    @classmethod
    def of(cls, points: NDArray[np.float64], view: MaskedFrame, cells: int) -> _Cells:
        """With `cells` cells along the longer image side."""
        camera = view.frame.camera
        size = max(1, -(-max(camera.width, camera.height) // cells))
        columns, rows, inside = whole_pixels(points, camera)
        down, across = np.arange(0, camera.height, size), np.arange(0, camera.width, size)
        mask_pixels = np.add.reduceat(np.add.reduceat(view.mask, down, axis=0, dtype=np.int64), across, axis=1)
        cell = (rows // size * len(across) + columns // size).astype(
            np.int32
        )  # 32 bit: there is one per point and view
        return cls(mask_pixels, cell, inside)

    def near(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Cells, [H, W], with one of the `chosen` points in them or in a neighbour."""
        near = np.zeros(self.mask_pixels.size, np.bool_)
        near[self.cell[self.inside & chosen]] = True
        return dilated(near.reshape(self.mask_pixels.shape), 1)

    def at(self, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Points that project into one of the `cells`, [H, W]."""
        found: NDArray[np.bool_] = self.inside & cells.ravel()[self.cell]
        return found


def whole_pixels(
    points: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Pixel column and row of each point, and whether it is in front of the camera and inside the image."""
    pixels, depths = camera.project(points)
    u, v = pixels.T
    inside = (depths > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    columns = np.where(inside, u, 0).astype(np.int64)
    rows = np.where(inside, v, 0).astype(np.int64)
    return columns, rows, inside


def dilated(mask: NDArray[np.bool_], margin: int) -> NDArray[np.bool_]:
    values = torch.from_numpy(mask).float()[None, None]
    grown: NDArray[np.bool_] = (
        torch.nn.functional.max_pool2d(values, 2 * margin + 1, stride=1, padding=margin)[0, 0].numpy() > 0
    )
    return grown


def _components(grid: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Connected components (8 neighbours) of `grid` [H, W]: a number per component, 0 for empty cells."""
    full = torch.from_numpy(grid).float()[None, None]
    numbers = torch.arange(1, grid.size + 1, dtype=torch.float32).reshape(full.shape) * full
    while not torch.equal(numbers, larger := torch.nn.functional.max_pool2d(numbers, 3, stride=1, padding=1) * full):
        numbers = larger
    components: NDArray[np.int64] = numbers[0, 0].long().numpy()
    return components
