"""Carving: which random points the images allow, and in how much of the clip what they show stays in place.

A point is allowed that most views in which it lies show something at. Where things move far, no point is, for the whole
clip taken as one instant; for a short part of it some are. Knows nothing of anchors, networks or random streams.
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

# Shares of the views that are asked for before the configured one: what stands still meets the first.
STRICTER_FRACTIONS: Final = (0.95, 0.9, 0.85, 0.8, 0.75, 0.7, 0.65)

# A mask is dilated by this many pixels, so that a thin moving part still counts as hit.
MASK_MARGIN: Final = 2

# With fewer points than this the vote has failed: no place shows something at most times.
MIN_CARVED: Final = 100

# Points stand for what a picture shows in one piece where they lie within about one spacing of this share of it. Of the
# clips looked at, those that train well as a whole have 0.74 and more, and two in which a ball is lost 0.42 and less.
MIN_COVERAGE: Final = 0.6

# This share of the views may be worse: a few wrong masks, or things seen in passing.
OUTLIER_FRACTION: Final = 0.05

# Pieces of less than this share of what a picture shows are not worth a shorter part of the clip.
SMALLEST_PIECE: Final = 0.01

# Shares of the clip that are tried, and the fewest views that may speak for one.
WINDOW_FRACTIONS: Final = (1.0, 0.5, 0.25, 0.1)
MIN_VIEWS: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class MaskedFrame:
    """A frame, where it shows something, [H, W], and whether any of it is opaque, of whatever colour."""

    frame: Frame
    mask: NDArray[np.bool_]
    opaque: bool


def masked(frames: Sequence[Frame], images: ImageStore, background: Sequence[float]) -> list[MaskedFrame]:
    """What each of `frames` shows: where it is opaque and not of the background's colour, which needs no Gaussians."""
    found = []
    for frame in frames:
        alpha = images.alpha(frame)
        differs = np.abs(images.rgb(frame) - np.asarray(background, np.float32)).max(axis=-1) > COLOR_TOLERANCE
        opaque = np.ones_like(differs) if alpha is None else alpha > 0.5
        found.append(MaskedFrame(frame, opaque & differs, bool(opaque.any())))
    return found


def check_not_empty(views: Sequence[MaskedFrame]) -> None:
    """Raise `CaptureError` where all of `views` are transparent everywhere."""
    if not any(view.opaque for view in views):
        raise CaptureError(
            "every mask is empty: there is nothing to see in any training image",
            file=views[0].frame.name,
            field="alpha",
            remedy="Check the alpha channel of the images, or remove it.",
        )


def carve(points: NDArray[np.float64], views: Sequence[MaskedFrame], vote: float, cells: int) -> NDArray[np.float64]:
    """Those of `points` [M, 3] that the images allow, as few as show what the images do.

    Allowed is what lies on the dilated mask of at least a share `vote` of the views in which it lies. Where things move
    that has to be a low one, and what stands still then has a fog about it, which most views see past: a plate seen
    from above becomes two cones, base to base. So what nearly all views agree on comes first, and of what fewer do only
    what `OUTLIER_FRACTION` of the views or more have no point for yet, in a picture whose longer side is `cells` long.
    """
    share = _votes(points, views)
    points, share = points[share >= vote], share[share >= vote]
    seen = [_Cells.of(points, view, cells) for view in views]
    kept = share >= STRICTER_FRACTIONS[0]
    for least in (*[level for level in STRICTER_FRACTIONS[1:] if level > vote], vote):
        missed = np.zeros(len(points), np.int64)
        for view in seen:
            missed += view.at(~view.near(kept) & (view.shown > 0))
        kept |= (share >= least) & (missed >= OUTLIER_FRACTION * len(views))
    few: NDArray[np.float64] = points[kept]
    return few if len(few) >= MIN_CARVED else points


def _votes(points: NDArray[np.float64], views: Sequence[MaskedFrame]) -> NDArray[np.float64]:
    """Of the views in which each of `points` lies, the share on whose dilated mask it does."""
    votes, seen = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for view in views:
        columns, rows, inside = _whole_pixels(points, view.frame.camera)
        mask = _dilated(view.mask, MASK_MARGIN)
        seen += inside
        votes[inside] += mask[rows[inside], columns[inside]]
    # A point that no view sees is never allowed: nothing could train it.
    return np.where(seen > 0, votes / np.maximum(seen, 1), -1.0)


def coverage(points: NDArray[np.float64], views: Sequence[MaskedFrame], cells: int) -> float:
    """Share of its least covered piece that lies within a cell of a point, in all but a share
    `OUTLIER_FRACTION` of `views`.

    What hangs together in a picture is one piece: where a part of it has points the rest can grow, and a thing of its
    own that has none is not found. `points` [M, 3] are in normalised units, and a picture's longer side is `cells`
    long. 1 where no view shows anything.
    """
    shares = []
    for view in views:
        if not view.mask.any():
            continue
        seen = _Cells.of(points, view, cells)
        pieces = _pieces(seen.shown > 0).ravel()
        whole = np.bincount(pieces, seen.shown.ravel())
        covered = np.bincount(pieces, np.where(seen.near(np.ones(len(points), np.bool_)), seen.shown, 0).ravel())
        counts = whole >= min(SMALLEST_PIECE * whole.sum(), whole.max())
        shares.append(float((covered[counts] / whole[counts]).min()))
    return float(np.quantile(shares, OUTLIER_FRACTION)) if shares else 1.0


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """A view in cells of several pixels: how many of each, [H, W], show something, and which cell each point is in."""

    shown: NDArray[np.int64]
    cell: NDArray[np.int32]  # in rows, one after the other; of a point outside of the picture it says nothing
    inside: NDArray[np.bool_]

    @classmethod
    def of(cls, points: NDArray[np.float64], view: MaskedFrame, cells: int) -> _Cells:
        """The picture's longer side is `cells` long."""
        camera = view.frame.camera
        size = max(1, -(-max(camera.width, camera.height) // cells))
        columns, rows, inside = _whole_pixels(points, camera)
        down, across = np.arange(0, camera.height, size), np.arange(0, camera.width, size)
        shown = np.add.reduceat(np.add.reduceat(view.mask, down, axis=0, dtype=np.int64), across, axis=1)
        cell = (rows // size * len(across) + columns // size).astype(np.int32)  # many points, and as often as views
        return cls(shown, cell, inside)

    def near(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Cells, [H, W], that have one of the `chosen` points in them or next to them."""
        near = np.zeros(self.shown.size, np.bool_)
        near[self.cell[self.inside & chosen]] = True
        return _dilated(near.reshape(self.shown.shape), 1)

    def at(self, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Points that are in one of the `cells`, [H, W]."""
        found: NDArray[np.bool_] = self.inside & cells.ravel()[self.cell]
        return found


def _whole_pixels(
    points: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Pixel column and row of each point, and whether it is in front of the camera and inside the image."""
    pixels, depths = camera.project(points)
    u, v = pixels.T
    inside = (depths > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    columns = np.where(inside, u, 0).astype(np.int64)
    rows = np.where(inside, v, 0).astype(np.int64)
    return columns, rows, inside


def _dilated(mask: NDArray[np.bool_], margin: int) -> NDArray[np.bool_]:
    values = torch.from_numpy(mask).float()[None, None]
    grown: NDArray[np.bool_] = (
        torch.nn.functional.max_pool2d(values, 2 * margin + 1, stride=1, padding=margin)[0, 0].numpy() > 0
    )
    return grown


def _pieces(grid: NDArray[np.bool_]) -> NDArray[np.int64]:
    """A number for each full cell of `grid` [H, W], one for all that touch by sides or corners; 0 for empty cells."""
    full = torch.from_numpy(grid).float()[None, None]
    numbers = torch.arange(1, grid.size + 1, dtype=torch.float32).reshape(full.shape) * full
    while not torch.equal(numbers, larger := torch.nn.functional.max_pool2d(numbers, 3, stride=1, padding=1) * full):
        numbers = larger
    pieces: NDArray[np.int64] = numbers[0, 0].long().numpy()
    return pieces
