"""Metrics: how far a rendered image is from the photograph.

Every number is taken per image, on values rounded to 8 bits as a saved PNG would hold them, and then averaged
over images. Names carry the definition, because definitions differ: the SSIM of other packages is up to 0.02
away from `ssim_3dgs` for the same two images. Images are [H, W, 3] in [0, 1].

Where an image has a mask, its numbers are those of the valid pixels, as the mPSNR, mSSIM and mLPIPS of Gao et al.
("Monocular Dynamic View Synthesis", 2022): no value of a masked pixel changes them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from graings.constants import SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from graings.document import Document
from graings.evaluation.perceptual import LPIPS_MIN_SIDE, Image, PerceptualDistances

Mask = NDArray[np.bool_]

# Below this mean squared error PSNR is 100 dB: the logarithm of 0, the error of two equal images, is not finite.
MSE_FLOOR: Final = 1e-10
PSNR_CAP: Final = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """A rendered image, its photograph [H, W, 3], and the `valid` pixels [H, W] that are compared (None: all)."""

    name: str
    time: float
    image: ArrayLike
    target: ArrayLike
    valid: Mask | None = None


class ViewMetrics(Document):
    """One rendered image against its photograph."""

    name: str = Field(description="File name of the photograph, relative to the capture.")
    time: float = Field(description="Normalised time of the view in [0, 1].")
    psnr: float = Field(le=PSNR_CAP, description="Peak signal-to-noise ratio in dB, at most 100.")
    ssim_3dgs: float = Field(ge=-1, le=1, description="Structural similarity as 3D Gaussian Splatting computes it.")
    lpips_vgg: float | None = Field(description="LPIPS distance with VGG weights; null where it was not measured.")
    flip_ldr: float | None = Field(description="Mean LDR-FLIP error in [0, 1]; null where it was not measured.")
    mse: float = Field(ge=0, description="Mean squared error over pixels and channels in [0, 1].")
    compared: float = Field(
        1.0, gt=0, le=1, description="Share of the pixels that the numbers are about; below 1 where some are masked."
    )


class SplitMeans(Document):
    """Means over the views of a split."""

    psnr: float | None = Field(le=PSNR_CAP, description="Mean over views of their PSNR in dB; null without a view.")
    ssim_3dgs: float | None = Field(ge=-1, le=1, description="Mean over views; null without a view.")
    lpips_vgg: float | None = Field(description="Mean over views; null where any view has none.")
    lpips_reason: str | None = Field(description="Why `lpips_vgg` is null; null where it is not.")
    flip_ldr: float | None = Field(description="Mean over views of LDR-FLIP; null where any view has none.")
    flip_reason: str | None = Field(description="Why `flip_ldr` is null; null where it is not.")
    saturated: bool = Field(
        description="Whether the PSNR of some image is the cap of 100 dB: it has a dozen wrong values at most."
    )
    reason: str | None = Field(None, description="Why all means are null; null where they are not.")


class SplitMetrics(SplitMeans):
    """Means over the views of a split, and every view."""

    views: tuple[ViewMetrics, ...] = Field(description="The views, in the order of the split.")

    @staticmethod
    def over(
        views: Sequence[ViewMetrics],
        distances: PerceptualDistances | None = None,
        reason: str = "the split has no images",
    ) -> SplitMetrics:
        """Average `views`; `distances` are those that were measured on them, `reason` is why there is no view."""
        if not views:
            return SplitMetrics(
                psnr=None,
                ssim_3dgs=None,
                lpips_vgg=None,
                lpips_reason=reason,
                flip_ldr=None,
                flip_reason=reason,
                saturated=False,
                reason=reason,
                views=(),
            )
        lpips = _mean_of_all([view.lpips_vgg for view in views])
        flip = _mean_of_all([view.flip_ldr for view in views])
        lpips_reason, flip_reason = "LPIPS was not requested", "FLIP was not requested"
        if distances is not None:
            lpips_reason = distances.lpips.reason or f"images under {LPIPS_MIN_SIDE} pixels have no LPIPS"
            flip_reason = distances.flip.reason or "some views were not measured"
        return SplitMetrics(
            psnr=math.fsum(view.psnr for view in views) / len(views),
            ssim_3dgs=math.fsum(view.ssim_3dgs for view in views) / len(views),
            lpips_vgg=lpips,
            lpips_reason=lpips_reason if lpips is None else None,
            flip_ldr=flip,
            flip_reason=flip_reason if flip is None else None,
            saturated=any(view.mse <= MSE_FLOOR for view in views),
            views=tuple(views),
        )


def measure_split(pairs: Iterable[Pair], distances: PerceptualDistances | None = None) -> SplitMetrics:
    """Metrics of a split, one pair in memory at a time. Images that are masked everywhere are left out."""
    views, masked = list[ViewMetrics](), 0
    for pair in pairs:
        if pair.valid is None or pair.valid.any():
            views.append(measure(pair, distances))
        else:
            masked += 1
    return SplitMetrics.over(views, distances, *(["masks hide all pixels of the split's images"] if masked else []))


def measure(pair: Pair, distances: PerceptualDistances | None = None) -> ViewMetrics:
    """All metrics of one image, which has at least one valid pixel."""
    image, target = _rounded_pair(pair.image, pair.target)
    valid = np.ones(image.shape[:2], np.bool_) if pair.valid is None else pair.valid
    share, error = float(valid.mean()), _mse(image[valid], target[valid])
    # The perceptual distances are means over the image: to them masked pixels are grey in both and differ by nothing.
    shown = [np.where(valid[..., None], each, 0.5) for each in (image, target)]
    lpips, flip = (None, None) if distances is None else (distances.lpips(*shown), distances.flip(*shown))
    return ViewMetrics(
        name=pair.name,
        time=float(pair.time),
        psnr=_psnr_of(error),
        ssim_3dgs=_ssim(image, target, pair.valid),
        lpips_vgg=None if lpips is None else lpips / share,
        flip_ldr=None if flip is None else flip / share,
        mse=error,
        compared=share,
    )


def _mean_of_all(values: Sequence[float | None]) -> float | None:
    """The mean, or None where any value is missing."""
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if len(known) == len(values) else None


def psnr(image: ArrayLike, target: ArrayLike) -> float:
    """Peak signal-to-noise ratio in dB, -10 log10 MSE, at most 100."""
    return _psnr_of(_mse(*_rounded_pair(image, target)))


def ssim_3dgs(image: ArrayLike, target: ArrayLike, valid: Mask | None = None) -> float:
    """Structural similarity in [-1, 1] as 3D Gaussian Splatting computes it.

    Gaussian window of 11 x 11 with sigma 1.5, borders padded with zeros, mean over pixels and channels; in
    float64, with variances kept from falling below zero by rounding (Wang et al. 2004, Eq. 13). With `valid` [H, W]
    windows average over its pixels only, and the mean is over them.
    """
    return _ssim(*_rounded_pair(image, target), valid)


def _rounded_pair(image: ArrayLike, target: ArrayLike) -> tuple[Image, Image]:
    """Both images in float64, rounded to 8 bits."""
    pair = []
    for name, values in (("image", image), ("target", target)):
        array = np.asarray(values, dtype=np.float64)
        if array.ndim != 3 or array.shape[2] != 3 or array.size == 0:
            raise ValueError(f"{name} must have shape (H, W, 3), got {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite")
        pair.append(np.rint(np.clip(array, 0.0, 1.0) * 255.0) / 255.0)
    if pair[0].shape != pair[1].shape:
        raise ValueError(f"image and target must have the same size, got {pair[0].shape} and {pair[1].shape}")
    return pair[0], pair[1]


def _mse(image: Image, target: Image) -> float:
    return float(np.mean(np.square(image - target)))


def _psnr_of(mse: float) -> float:
    return PSNR_CAP if mse <= MSE_FLOOR else -10.0 * math.log10(mse)


def _ssim(image: Image, target: Image, valid: Mask | None) -> float:
    # One channel at a time: five maps of a 12-megapixel photograph are half a gigabyte.
    return math.fsum(_ssim_channel(image[..., c], target[..., c], valid) for c in range(3)) / 3.0


def _ssim_channel(x: Image, y: Image, valid: Mask | None) -> float:
    def mean(values: Image) -> Image:
        return _blur(values) if valid is None else _blur(values * valid) * weight

    if valid is not None:
        # Windows keep the weight that they have without the mask: below 1 only at the border of the image.
        share = _blur(valid.astype(np.float64))
        weight = _blur(np.ones_like(x)) / np.where(valid, share, 1.0)
    mean_x, mean_y = mean(x), mean(y)
    var_x = np.maximum(mean(x * x) - mean_x**2, 0.0)
    var_y = np.maximum(mean(y * y) - mean_y**2, 0.0)
    covariance = mean(x * y) - mean_x * mean_y
    luminance = (2.0 * mean_x * mean_y + SSIM_C1) / (mean_x**2 + mean_y**2 + SSIM_C1)
    structure = (2.0 * covariance + SSIM_C2) / (var_x + var_y + SSIM_C2)
    similarity = np.clip(luminance * structure, -1.0, 1.0)
    return float(np.mean(similarity if valid is None else similarity[valid]))


def _blur(values: Image) -> Image:
    """Convolution with the Gaussian window, zeros beyond the border, [H, W]."""
    reach = SSIM_WINDOW // 2
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SSIM_SIGMA) ** 2)
    weights /= weights.sum()
    for axis in (0, 1):
        values = np.moveaxis(values, axis, 0)
        padded = np.pad(values, [(reach, reach), (0, 0)])
        blurred = np.zeros_like(values)
        for i, weight in enumerate(weights):
            blurred += weight * padded[i : i + values.shape[0]]
        values = np.moveaxis(blurred, 0, axis)
    return values
