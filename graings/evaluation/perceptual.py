"""Perceptual distances of two images, where their optional packages are installed: LPIPS and FLIP.

Images are [H, W, 3] float64 in [0, 1]. A distance that cannot be measured is None, and `reason` says why. Nothing is
ever downloaded.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

Image = NDArray[np.float64]

# VGG halves the image five times, which leaves no pixel of a smaller image.
LPIPS_MIN_SIDE: Final = 32
# torchvision names weight files after the first digits of their sha256.
VGG_FILE: Final = "vgg16-397923af.pth"


@dataclass(frozen=True, slots=True)
class PerceptualDistances:
    """The distances that an evaluation measures beside PSNR and SSIM."""

    lpips: Lpips
    flip: Flip

    @staticmethod
    def find() -> PerceptualDistances:
        """What is installed on this machine, and the reasons for what is not."""
        return PerceptualDistances(Lpips.find(), Flip.find())


class Lpips:
    """Learned perceptual distance with VGG weights (Zhang et al. 2018)."""

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

    def __call__(self, image: Image, target: Image) -> float | None:
        """Distance of two images, or None without weights or below 32 pixels."""
        if self._network is None or min(image.shape[:2]) < LPIPS_MIN_SIDE:
            return None
        with torch.inference_mode():
            batch = [torch.from_numpy(x).float().permute(2, 0, 1)[None] * 2.0 - 1.0 for x in (image, target)]
            return float(self._network(*batch))


class Flip:
    """LDR-FLIP (Andersson et al. 2020) at 67 pixels per degree, by NVIDIA's package: the mean of its error map."""

    def __init__(self, evaluate: Callable[..., tuple[Any, float, Any]] | None, reason: str | None) -> None:
        self._evaluate = evaluate
        self.reason = reason

    @staticmethod
    def find() -> Flip:
        """The package `flip_evaluator`, or the reason why there is none."""
        try:
            import flip_evaluator  # optional extra [flip]
        except ModuleNotFoundError:
            return Flip(None, "the package flip-evaluator is not installed (pip install 'graings[flip]')")
        except ImportError as error:
            return Flip(None, f"the package flip-evaluator does not load: {error}")
        return Flip(flip_evaluator.evaluate, None)

    def __call__(self, image: Image, target: Image) -> float | None:
        """Mean error in [0, 1] of `image` against the reference `target`, or None without the package."""
        if self._evaluate is None:
            return None
        reference, test = (np.ascontiguousarray(x, dtype=np.float32) for x in (target, image))
        return float(self._evaluate(reference, test, "LDR", applyMagma=False)[1])


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
