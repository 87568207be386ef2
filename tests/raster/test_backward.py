"""The backward pass obtains transmittance by division: deep and opaque stacks of Gaussians."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from graings.gaussians import Gaussians
from graings.raster import reference
from graings.raster.rasterize import rasterize
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings
from tests.raster.comparison import UNIT_ROUNDOFF, draw, relative, upstream
from tests.raster.evidence import within
from tests.scenes import FLOATS, cast, gaussians, overlapping, pinhole

UNTRUNCATED = RasterSettings(alpha_min=0.0, transmittance_min=0.0)


def stack(count: int, opacity: tuple[float, float], behind: int = 0) -> Gaussians:
    """Wide Gaussians one behind the other, the last `behind` of them opaque."""
    batch = gaussians(count, 40, spread=0.05, log_scales=(0.5, 1.0), opacity=opacity)
    order = batch.means[:, 2].argsort()
    batch = replace(batch, means=batch.means[order])
    opacities = batch.opacities.clone()
    opacities[count - behind :] = 0.99
    return replace(batch, opacities=opacities)


@pytest.mark.parametrize(
    ("count", "opacity", "behind"), [(900, (0.009, 0.011), 0), (300, (0.005, 0.9), 0), (300, (0.009, 0.011), 5)]
)
def test_weights_of_the_backward_pass_are_those_of_the_forward_pass(
    count: int, opacity: tuple[float, float], behind: int
) -> None:
    """With an upstream gradient of 1 the gradient of a colour is its sum of weights, up to two roundings per entry."""
    batch, camera = cast(stack(count, opacity, behind), torch.float32), pinhole(16, 16)
    ones = torch.zeros(16, 16, 5, dtype=torch.float64)
    ones[..., 0] = 1
    single = draw(rasterize, batch, camera, ones).gradients["colors"][:, 0].double()
    exact = draw(rasterize, cast(batch, torch.float64), camera, ones).gradients["colors"][:, 0]
    seen = exact > 0
    error = ((single - exact)[seen] / exact[seen]).abs().max().item()
    within("weight of a Gaussian, relative", error, 2 * (count + 32) * UNIT_ROUNDOFF)


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 2e-5), (torch.float64, 1e-9)])
def test_an_opaque_wall_without_a_stop_has_the_gradient_of_its_front(dtype: torch.dtype, bound: float) -> None:
    """400 layers of alpha 0.99 have a transmittance of 1e-800, which underflows; nothing may divide by it."""
    batch, camera = cast(stack(400, (0.99, 0.99)), dtype), pinhole(16, 16)
    cotangent = upstream(camera)
    ours = draw(rasterize, batch, camera, cotangent, settings=UNTRUNCATED)
    oracle = draw(reference.rasterize, cast(batch, torch.float64), camera, cotangent, settings=UNTRUNCATED)
    for name in FLOATS:
        assert ours.gradients[name].isfinite().all(), name
        within(f"{dtype} gradient of {name}", relative(ours.gradients[name], oracle.gradients[name]), bound)


def test_a_background_without_a_gradient_does_not_change_other_gradients() -> None:
    batch, camera = overlapping()
    gradients = {}
    for requires_grad in (True, False):
        leaf = batch.means.clone().requires_grad_()
        background = torch.full((3,), 0.3, dtype=torch.float64, requires_grad=requires_grad)
        image = rasterize(replace(batch, means=leaf), camera, background).color
        (image * upstream(camera)[..., :3]).sum().backward()
        gradients[requires_grad] = leaf.grad
        assert (background.grad is not None) == requires_grad
    assert gradients[True] is not None
    assert gradients[False] is not None
    assert torch.equal(gradients[True], gradients[False])


def test_blocks_without_upstream_gradient_are_skipped_but_nan_is_not() -> None:
    """Blocks whose upstream gradient is 0 are skipped without changing the result; a NaN there shows."""
    batch, camera = overlapping()
    everywhere, corner = upstream(camera), torch.zeros_like(upstream(camera))
    corner[:6, :6] = everywhere[:6, :6]
    oracle = draw(reference.rasterize, batch, camera, corner)
    ours = draw(rasterize, batch, camera, corner)
    for name in FLOATS:
        assert relative(ours.gradients[name], oracle.gradients[name]) <= 1e-9, name
    corner[3, 3] = torch.nan
    assert draw(rasterize, batch, camera, corner).gradients["means"].isnan().any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"alpha_max": 1.0}, "0 <= alpha_min < alpha_max < 1 expected, got .* and 1.0"),
        ({"alpha_min": -0.1}, "0 <= alpha_min < alpha_max < 1"),
        ({"alpha_min": 0.995}, "0 <= alpha_min < alpha_max < 1"),
        ({"transmittance_min": 1.0}, r"transmittance_min must lie in \[0, 1\), got 1.0"),
        ({"near": 2.0, "far": 1.0}, "0 <= near < far expected, got 2.0 and 1.0"),
        ({"blur": -1.0}, "blur >= 0 and frustum_margin >= -1 expected, got -1.0"),
    ],
)
def test_invalid_settings_are_refused_by_name(change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(DEFAULT_SETTINGS, **change)  # type: ignore[arg-type]
