"""The kernel equals the oracle: in double precision to rounding, in single precision within derived bounds."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from graings.raster import reference
from graings.raster.rasterize import rasterize
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings
from tests.raster.comparison import UNIT_ROUNDOFF, decisions, draw, relative, upstream
from tests.raster.evidence import within
from tests.scenes import SCENES, Scene, cast, gaussians, overlapping, pinhole, wide

# Norm-wise, per group of parameters: fifty times the 4e-7 measured for float32 pixels over float64 geometry.
GRADIENT_BOUND = 2e-5

SIZES = [(1, 1), (1, 7), (7, 1), (15, 15), (16, 16), (17, 33), (33, 47), (257, 1)]


def assert_double_agrees(scene: Scene, settings: RasterSettings = DEFAULT_SETTINGS) -> None:
    batch, camera = scene
    cotangent = upstream(camera)
    ours = draw(rasterize, batch, camera, cotangent, settings=settings)
    oracle = draw(reference.rasterize, batch, camera, cotangent, settings=settings)
    assert ours.result.culled == oracle.result.culled
    for name, image in ours.images().items():
        expected = oracle.images()[name]
        error = ((image - expected).abs() / expected.abs().clamp(min=1)).max().item()
        within(f"float64 {name} against the oracle", error, 1e-9)
    torch.testing.assert_close(ours.result.means2d, oracle.result.means2d, rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(ours.result.radii, oracle.result.radii, rtol=1e-9, atol=1e-9)
    assert ours.gradients.keys() == oracle.gradients.keys()
    for name, gradient in ours.gradients.items():
        within(f"float64 gradient of {name}", relative(gradient, oracle.gradients[name]), 1e-9)


@pytest.mark.parametrize("name", SCENES)
def test_double_kernel_equals_oracle(name: str, isa: str) -> None:
    assert_double_agrees(SCENES[name]())


@pytest.mark.parametrize("size", SIZES)
def test_double_kernel_equals_oracle_at_any_image_size(size: tuple[int, int]) -> None:
    scene = (gaussians(30, 11, spread=0.4, log_scales=(-2.0, 0.0)), pinhole(*size))
    assert_double_agrees(scene)


@pytest.mark.parametrize(
    "settings",
    [
        RasterSettings(alpha_min=0.0, transmittance_min=0.0),
        RasterSettings(compat=True),
        RasterSettings(alpha_min=0.05, transmittance_min=0.2, alpha_max=0.7, blur=0.1, near=2.5, frustum_margin=0.0),
    ],
    ids=["untruncated", "compat", "unusual"],
)
@pytest.mark.parametrize("build", [overlapping, wide])
def test_double_kernel_equals_oracle_with_other_settings(
    build: Callable[[], Scene], settings: RasterSettings, isa: str
) -> None:
    assert_double_agrees(build(), settings)


@pytest.mark.parametrize("name", SCENES)
def test_single_precision_stays_within_its_bounds(name: str, isa: str) -> None:
    """Compared with the float64 image of the same float32 inputs, at pixels where rounding decides no threshold."""
    batch, camera = SCENES[name]()
    single = cast(batch, torch.float32)
    exact = cast(single, torch.float64)
    choice = decisions(exact, camera)
    assert choice.steady.double().mean() > 0.5
    cotangent = upstream(camera, keep=choice.steady).float().double()
    # alpha has at most 30 units of roundoff; sums over n contributors add sqrt(n)
    bound = (32 + 4 * math.sqrt(choice.deepest)) * UNIT_ROUNDOFF
    ours = draw(rasterize, single, camera, cotangent)
    oracle = draw(reference.rasterize, exact, camera, cotangent)
    for image_name, image in ours.images().items():
        expected = oracle.images()[image_name]
        unit = (
            max(1.0, expected.abs().max().item()) if image_name == "depth" else 1.0
        )  # colours and alpha are in [0, 1]
        error = (image.double() - expected).abs()[choice.steady].max().item()
        within(f"float32 {image_name}", error, bound * unit)
        if image_name != "depth":
            tipped = (image.double() - expected).abs()[~choice.steady]
            assert tipped.numel() == 0 or tipped.max().item() <= 1 / 255 + 1e-4
    for group, gradient in ours.gradients.items():
        assert gradient.isfinite().all(), group
        within(f"float32 gradient of {group}", relative(gradient, oracle.gradients[group]), GRADIENT_BOUND)


def test_gradcheck_passes_on_the_double_kernel() -> None:
    """Central differences with nothing truncated, so that every function is smooth."""
    batch, camera = gaussians(6, 12, spread=0.3, log_scales=(-2.0, -0.5), opacity=(0.1, 0.8)), pinhole(9, 7, focal=8.0)
    settings = RasterSettings(alpha_min=0.0, transmittance_min=0.0)
    floats = (batch.means, batch.quats, batch.log_scales, batch.opacities, batch.colors)
    offset, background = torch.zeros(6, 2, dtype=torch.float64), torch.rand(3, dtype=torch.float64)

    def render_view(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        result = rasterize(
            type(batch)(*values[:5], batch.uids), camera, values[5], means2d_offset=values[6], settings=settings
        )
        return result.color, result.alpha, result.depth

    leaves = [value.clone().requires_grad_() for value in (*floats, background, offset)]
    assert torch.autograd.gradcheck(render_view, leaves, eps=1e-6, atol=1e-6, rtol=1e-5)
