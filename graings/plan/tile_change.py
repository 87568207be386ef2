"""Tile change: whether images of one camera at several times differ by more than their noise.

Global means would dilute a small object that moves, so the test looks at tiles of 16 x 16 pixels (numerics notes, 5.2).
A gain and an offset of each image are fitted first: exposure is appearance, not motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graings.constants import TILE

Images = NDArray[np.float32]  # [image, height, width, 3] in [0, 1]

HALF_LEVEL: Final = 1 / 510  # half a grey level of 8 bits

# Limits in units of the noise: five standard deviations of the mean of 256 pixels, and of their RMS (chi-square).
MEAN_LIMIT: Final = 5 / TILE
RMS_LIMIT: Final = 1.2

MAD_TO_SIGMA: Final = 1 / 0.6745  # of a normal distribution
TRIM: Final = 2.5  # residuals beyond this many standard deviations do not take part in the fit of gain and offset


@dataclass(frozen=True, slots=True)
class Change:
    """The tile that changed most. `ratio` is its change over the limit that noise explains; above 1 something changed.

    `value` is the RMS difference in [0, 1]; `tile` is (column, row) in tiles; `pair` are two indices of images, or an
    index and -1 for the median of all.
    """

    ratio: float
    value: float
    tile: tuple[int, int]
    pair: tuple[int, int]


def noise_sigma(images: Images) -> float:
    """Standard deviation of the noise of one camera's images, in [0, 1].

    The smaller of an estimate over space (Immerkaer, "Fast Noise Variance Estimation", 1996, with a median) and one of
    the differences of successive images: texture enlarges the first, motion the second.
    """
    spatial = float(np.median([_spatial_sigma(image) for image in images]))
    if len(images) < 2:
        return spatial
    steps = np.diff(_fewer(images), axis=0)
    # The median of a few whole grey levels is off by up to half a level: spread each evenly over its level.
    spread = np.random.default_rng(0).uniform(-HALF_LEVEL, HALF_LEVEL, steps.shape)
    median = float(np.median(np.abs(steps + spread)))
    return min(spatial, float(np.sqrt(max(0.0, median**2 - HALF_LEVEL**2 / 4))) * MAD_TO_SIGMA / np.sqrt(2.0))


def gains(images: Images, sigma: float) -> NDArray[np.float64]:
    """Gain and offset [image, 2] that map the median image onto each image, fitted without what moves."""
    few = _fewer(images)
    median = np.median(few, axis=0)
    return np.array([_fit(median, image, sigma) for image in few])


def largest_change(images: Images, sigma: float, fits: NDArray[np.float64]) -> Change:
    """The tile with the largest change against the median image, and of the last against the first.

    `images` are of one camera and ascend in time; `fits` are their gains and offsets.
    """
    equal = (images - fits[:, 1, None, None, None]) / np.maximum(fits[:, 0, None, None, None], 1e-3)
    median = np.median(equal, axis=0)
    found = [_worst_tile(image - median, sigma, (index, -1)) for index, image in enumerate(equal)]
    found.append(_worst_tile(equal[-1] - equal[0], sigma * np.sqrt(2.0), (0, len(images) - 1)))
    return max(found, key=lambda change: change.ratio)


def _fewer(images: Images) -> Images:
    """Every third pixel of every third row of large images: enough for a median or a fit."""
    stride = 1 if images.shape[1] * images.shape[2] < 20_000 else 3
    return images[:, ::stride, ::stride]


def _worst_tile(difference: NDArray[np.floating], sigma: float, pair: tuple[int, int]) -> Change:
    height, width = difference.shape[:2]
    rows, columns = np.arange(0, height, TILE), np.arange(0, width, TILE)
    count = np.outer(np.diff([*rows, height]), np.diff([*columns, width]))
    # A tile cut off by the border has fewer pixels, and a mean with more noise.
    wider = np.sqrt(TILE * TILE / count)

    def tile_means(values: NDArray[np.floating]) -> NDArray[np.float64]:
        sums = np.add.reduceat(np.add.reduceat(values, rows, axis=0, dtype=np.float64), columns, axis=1)
        return sums / (count[..., None] if values.ndim == 3 else count)

    mean = np.abs(tile_means(difference)).max(-1)
    rms = np.sqrt(tile_means(np.square(difference)).mean(-1))
    ratio = np.maximum(
        mean / np.maximum(HALF_LEVEL, MEAN_LIMIT * sigma * wider),
        rms / np.maximum(HALF_LEVEL, (1 + (RMS_LIMIT - 1) * wider) * sigma),
    )
    row, column = np.unravel_index(int(ratio.argmax()), ratio.shape)
    return Change(float(ratio[row, column]), float(rms[row, column]), (int(column), int(row)), pair)


def _fit(median: NDArray[np.floating], image: NDArray[np.floating], sigma: float) -> tuple[float, float]:
    x, y = median.ravel().astype(np.float64), image.ravel().astype(np.float64)
    gain, offset = 1.0, 0.0
    for _ in range(3):
        residual = y - (gain * x + offset)
        spread = float(np.median(np.abs(residual - np.median(residual)))) * MAD_TO_SIGMA
        kept = np.abs(residual - np.median(residual)) <= TRIM * max(spread, sigma, HALF_LEVEL)
        a, b = x[kept], y[kept]
        variance = float(a.var())
        if variance <= (4 * sigma) ** 2 + HALF_LEVEL**2:  # a flat image has no contrast to fit a gain to
            gain, offset = 1.0, float((b - a).mean())
        else:
            gain = float(((a - a.mean()) * (b - b.mean())).mean() / variance)
            offset = float(b.mean() - gain * a.mean())
    return gain, offset


def _spatial_sigma(image: NDArray[np.floating]) -> float:
    if min(image.shape[:2]) < 3:
        return 0.0
    rows = image[:-2] - 2 * image[1:-1] + image[2:]
    laplacian = rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:]
    return float(np.median(np.abs(laplacian))) * MAD_TO_SIGMA / 6.0
