"""Shared by the tests of extreme cases: derived bounds, central differences, and peak memory."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from graings.camera.camera import Camera
from graings.gaussians import Gaussians
from graings.raster import reference
from graings.raster.rasterize import rasterize
from graings.raster.result import RasterSettings
from tests.raster.comparison import BACKGROUND, UNIT_ROUNDOFF, decisions, draw, relative, upstream
from tests.raster.evidence import within
from tests.scenes import FLOATS, Scene, cast

# No truncation: the image is a smooth function of all inputs while the depth order stays the same.
SMOOTH = RasterSettings(alpha_min=0.0, transmittance_min=0.0)

# Per group of parameters: fifty times the 4e-7 measured for float32 pixels over float64 geometry.
GRADIENT_NORM = 2e-5
GRADIENT_LARGEST = 1e-4

# A pixel changes by at most this if rounding reverses one threshold decision.
FLIP = 1 / 255 + 1e-4


def forward_bound(contributors: int) -> float:
    """Alpha has at most 30 units of roundoff; sums over n contributors add sqrt(n)."""
    return (32 + 4 * math.sqrt(contributors)) * UNIT_ROUNDOFF


def assert_single_precision_holds(scene: Scene) -> None:
    """Compares the float32 kernel with the float64 oracle on the same float32 inputs, images and gradients."""
    batch, camera = scene
    single = cast(batch, torch.float32)
    exact = cast(single, torch.float64)
    choice = decisions(exact, camera)
    assert choice.steady.double().mean() > 0.5
    cotangent = upstream(camera, keep=choice.steady).float().double()
    ours = draw(rasterize, single, camera, cotangent)
    oracle = draw(reference.rasterize, exact, camera, cotangent)
    for name, image in ours.images().items():
        expected = oracle.images()[name]
        unit = max(1.0, expected.abs().max().item()) if name == "depth" else 1.0  # colours and alpha are in [0, 1]
        error = (image.double() - expected).abs() / unit
        within(f"float32 {name}", error[choice.steady].max().item(), forward_bound(choice.deepest))
        assert (error[~choice.steady] <= FLIP).all(), name
    for name, gradient in ours.gradients.items():
        expected = oracle.gradients[name]
        assert gradient.isfinite().all(), name
        within(f"float32 gradient of {name}", relative(gradient, expected), GRADIENT_NORM)
        largest = expected.abs().max().item()
        error = (gradient.double() - expected).abs().max().item()
        within(f"float32 largest gradient of {name}", error, GRADIENT_LARGEST * largest)


def central_differences(
    batch: Gaussians, camera: Camera, cotangent: Tensor, *, step: float = 6e-6
) -> dict[str, Tensor]:
    """Gradient of every input by differences of the oracle, untruncated; `step` is about the cube root of 2^-53."""
    background = torch.tensor(BACKGROUND, dtype=torch.float64)

    def value(moved: Gaussians) -> float:
        result = reference.rasterize(moved, camera, background, settings=SMOOTH)
        image = torch.cat([result.color, result.alpha[..., None], result.depth[..., None]], 2)
        return (image * cotangent).sum().item()

    gradients = {}
    for name in FLOATS:
        tensor: Tensor = getattr(batch, name)
        gradient = torch.zeros(tensor.numel(), dtype=torch.float64)
        for i in range(tensor.numel()):
            ends = []
            for sign in (1.0, -1.0):
                moved = tensor.clone()
                moved.view(-1)[i] += sign * step
                ends.append((moved.view(-1)[i].item(), value(replace(batch, **{name: moved}))))
            (above, high), (below, low) = ends
            gradient[i] = (high - low) / (above - below)
        gradients[name] = gradient.reshape(tensor.shape)
    return gradients


class PeakMemory:
    """Peak resident memory of this process during the block; on systems other than Linux the test is skipped."""

    def __enter__(self) -> PeakMemory:
        try:
            Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark
        except OSError:
            pytest.skip("the high-water mark of memory cannot be reset here")
        self.before = _status("VmRSS")
        return self

    def __exit__(self, *_: object) -> None:
        self.peak = _status("VmHWM")

    @property
    def taken(self) -> int:
        return self.peak - self.before


def _status(field: str) -> int:
    """A field of the process status, in bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{field}:"))
