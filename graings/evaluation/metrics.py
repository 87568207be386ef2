"""Metrics: how far a rendered image is from the photograph.

Every number is taken per image, on values rounded to 8 bits as a saved PNG would hold them, and then averaged
over images. Names carry the definition, because definitions differ: the SSIM of other packages is up to 0.02
away from `ssim_3dgs` for the same two images. Images are [H, W, 3] in [0, 1].
"""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from graings.document import Document

Image = NDArray[np.float64]

# Below this mean squared error PSNR is 100 dB: the logarithm of 0, the error of two equal images, is not finite.
MSE_FLOOR: Final = 1e-10
PSNR_CAP: Final = 100.0

# SSIM as 3D Gaussian Splatting defines it, for values in [0, 1]: (0.01)^2 and (0.03)^2.
SSIM_WINDOW: Final = 11
SSIM_SIGMA: Final = 1.5
SSIM_C1: Final = 1e-4
SSIM_C2: Final = 9e-4

# VGG halves the image five times, which leaves no pixel of a smaller image.
LPIPS_MIN_SIDE: Final = 32
# torchvision names weight files after the first digits of their sha256.
VGG_FILE: Final = "vgg16-397923af.pth"


class ViewMetrics(Document):
    """One rendered image against its photograph."""

    name: str = Field(description="File name of the photograph, relative to the capture.")
    time: float = Field(description="Normalised time of the view in [0, 1].")
    psnr: float = Field(le=PSNR_CAP, description="Peak signal-to-noise ratio in dB; 100 for equal images.")
    ssim_3dgs: float = Field(ge=-1, le=1, description="Structural similarity as 3D Gaussian Splatting computes it.")
    lpips_vgg: float | None = Field(description="LPIPS distance with VGG weights; null where it was not measured.")
    mse: float = Field(ge=0, description="Mean squared error over pixels and channels in [0, 1].")


class SplitMeans(Document):
    """Means over the views of a split."""

    psnr: float | None = Field(le=PSNR_CAP, description="Mean over views of their PSNR in dB; null without a view.")
    ssim_3dgs: float | None = Field(ge=-1, le=1, description="Mean over views; null without a view.")
    lpips_vgg: float | None = Field(description="Mean over views; null where any view has none.")
    lpips_reason: str | None = Field(description="Why `lpips_vgg` is null; null where it is not.")
    saturated: bool = Field(
        description="Whether some image equals its photograph to the last bit: its PSNR is then the cap of 100 dB."
    )
    reason: str | None = Field(None, description="Why all means are null; null where they are not.")


class SplitMetrics(SplitMeans):
    """Means over the views of a split, and every view."""

    views: tuple[ViewMetrics, ...] = Field(description="The views, in the order of the split.")

    @staticmethod
    def over(views: Sequence[ViewMetrics], lpips_reason: str | None = None) -> SplitMetrics:
        """Average `views`; `lpips_reason` is that of the `Lpips` that measured them."""
        if not views:
            reason = "the split has no images"
            return SplitMetrics(
                psnr=None,
                ssim_3dgs=None,
                lpips_vgg=None,
                lpips_reason=reason,
                saturated=False,
                reason=reason,
                views=(),
            )
        lpips = [view.lpips_vgg for view in views if view.lpips_vgg is not None]
        complete = len(lpips) == len(views)
        if not complete and lpips_reason is None:
            lpips_reason = f"images under {LPIPS_MIN_SIDE} pixels have no LPIPS"
        return SplitMetrics(
            psnr=math.fsum(view.psnr for view in views) / len(views),
            ssim_3dgs=math.fsum(view.ssim_3dgs for view in views) / len(views),
            lpips_vgg=math.fsum(lpips) / len(lpips) if complete else None,
            lpips_reason=None if complete else lpips_reason,
            saturated=any(view.mse <= MSE_FLOOR for view in views),
            views=tuple(views),
        )


def measure_split(pairs: Iterable[tuple[str, float, ArrayLike, ArrayLike]], lpips: Lpips | None = None) -> SplitMetrics:
    """Metrics of a split from its (name, time, image, photograph), one pair in memory at a time."""
    views = tuple(measure(name, time, image, target, lpips) for name, time, image, target in pairs)
    reason = "LPIPS was not requested" if lpips is None else lpips.reason
    return SplitMetrics.over(views, reason)


def measure(name: str, time: float, image: ArrayLike, target: ArrayLike, lpips: Lpips | None = None) -> ViewMetrics:
    """All metrics of one image."""
    image_, target_ = _pair(image, target)
    error = _mse(image_, target_)
    distance = lpips(image_, target_) if lpips is not None else None
    return ViewMetrics(
        name=name,
        time=float(time),
        psnr=_psnr_of(error),
        ssim_3dgs=_ssim(image_, target_),
        lpips_vgg=distance,
        mse=error,
    )


def psnr(image: ArrayLike, target: ArrayLike) -> float:
    """Peak signal-to-noise ratio in dB, -10 log10 MSE, at most 100."""
    return _psnr_of(_mse(*_pair(image, target)))


def ssim_3dgs(image: ArrayLike, target: ArrayLike) -> float:
    """Structural similarity in [-1, 1] as 3D Gaussian Splatting computes it.

    Gaussian window of 11 x 11 with sigma 1.5, borders padded with zeros, mean over pixels and channels; in
    float64, with variances kept from falling below zero by rounding (Wang et al. 2004, Eq. 13).
    """
    return _ssim(*_pair(image, target))


class Lpips:
    """Learned perceptual distance with VGG weights (Zhang et al. 2018), if they are on this machine.

    `reason` names what is missing; every distance is None then. Nothing is ever downloaded.
    """

    def __init__(self, network: torch.nn.Module | None, reason: str | None) -> None:
        self._network = network
        self.reason = reason

    @staticmethod
    def find() -> Lpips:
        """The package `lpips` with its VGG backbone from `$TORCH_HOME`, or the reason why there is none."""
        try:
            import lpips  # optional extra [lpips]
        except ModuleNotFoundError:
            return Lpips(None, "the package lpips is not installed (pip install 'graings[lpips]')")
        except (ImportError, RuntimeError) as error:
            # A torchvision built for another torch raises these; a run must not fail for an optional metric.
            return Lpips(None, f"the package lpips does not load: {error}")
        problem = _backbone_problem(Path(torch.hub.get_dir()) / "checkpoints" / VGG_FILE)
        if problem is not None:
            return Lpips(None, problem)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # lpips calls torchvision by deprecated names
            network: torch.nn.Module = lpips.LPIPS(net="vgg", verbose=False)
        return Lpips(network.eval().requires_grad_(False), None)

    def __call__(self, image: ArrayLike, target: ArrayLike) -> float | None:
        """Distance of two images, or None without weights or below 32 pixels."""
        image_, target_ = _pair(image, target)
        if self._network is None or min(image_.shape[:2]) < LPIPS_MIN_SIDE:
            return None
        with torch.inference_mode():
            batch = [torch.from_numpy(x).float().permute(2, 0, 1)[None] * 2.0 - 1.0 for x in (image_, target_)]
            return float(self._network(*batch))


def _backbone_problem(file: Path) -> str | None:
    """Why the VGG backbone cannot be used, or None. Its file name carries the start of its sha256."""
    where = f"{VGG_FILE} in $TORCH_HOME/hub/checkpoints"
    if not file.is_file() or not os.access(file, os.R_OK):
        return f"the VGG weights are not installed ({where})"
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    if not digest.startswith(VGG_FILE[6:14]):
        return f"the VGG weights are damaged: the checksum does not fit the name ({where})"
    return None


def _pair(image: ArrayLike, target: ArrayLike) -> tuple[Image, Image]:
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


def _ssim(image: Image, target: Image) -> float:
    # One channel at a time: five maps of a 12-megapixel photograph are half a gigabyte.
    return math.fsum(_ssim_channel(image[..., c], target[..., c]) for c in range(3)) / 3.0


def _ssim_channel(x: Image, y: Image) -> float:
    mean_x, mean_y = _blur(x), _blur(y)
    var_x = np.maximum(_blur(x * x) - mean_x**2, 0.0)
    var_y = np.maximum(_blur(y * y) - mean_y**2, 0.0)
    covariance = _blur(x * y) - mean_x * mean_y
    luminance = (2.0 * mean_x * mean_y + SSIM_C1) / (mean_x**2 + mean_y**2 + SSIM_C1)
    structure = (2.0 * covariance + SSIM_C2) / (var_x + var_y + SSIM_C2)
    return float(np.mean(np.clip(luminance * structure, -1.0, 1.0)))


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
