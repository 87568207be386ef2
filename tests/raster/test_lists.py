"""Lists of tiles, blocks and entries only save work: leaving out entries does not change the image."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from graings.gaussians import Gaussians
from graings.raster import reference
from graings.raster.rasterize import rasterize
from graings.raster.result import DEFAULT_SETTINGS, RasterSettings
from tests.raster.comparison import draw, relative, upstream
from tests.scenes import cast, gaussians, pinhole, rows


def test_the_smallest_difference_of_depth_takes_precedence_over_uids() -> None:
    """Depths a billionth apart have the same sorting key if other Gaussians are far away."""
    batch = gaussians(3, 29, spread=0.0, opacity=(0.9, 0.9))
    means = torch.tensor([[0.0, 0.0, 2 + 1e-9], [0.0, 0.0, 2.0], [0.0, 0.0, 1e6]], dtype=torch.float64)
    batch = replace(batch, means=means, uids=torch.arange(3))
    color = rasterize(batch, pinhole(15, 15), torch.zeros(3, dtype=torch.float64), threads=1).color[7, 7]
    assert (color - batch.colors[1]).norm() < (color - batch.colors[0]).norm()


def crowds() -> dict[str, Tensor]:
    """Depths of 500 Gaussians, from far apart to too close for a key of 32 bits."""
    even = torch.rand(500, generator=torch.Generator().manual_seed(73), dtype=torch.float64)
    far = torch.tensor([1e6], dtype=torch.float64)
    return {
        "even": 2 + even,
        "descending": 3 - even.sort().values,
        "two clusters": torch.where(even < 0.5, 2 + 1e-3 * even, 900 + even),
        "one far away": torch.cat([2 + 1e-3 * even[1:], far]),
        "one far away, the rest descending": torch.cat([far, 2.001 - 1e-3 * even[1:].sort().values]),
        "keys agree": torch.cat([2 + 1e-9 * even[1:], far]),
        "keys agree, descending": torch.cat([far, 2 + 1e-9 - 1e-9 * even[1:].sort().values]),
        "all equal": torch.full_like(even, 2.0),
    }


@pytest.mark.parametrize("crowd", crowds())
def test_gaussians_are_sorted_by_depth_for_any_distribution_of_crowded_depths(crowd: str, isa: str) -> None:
    """The sort compares leading bits first, in which some depths agree."""
    depths, camera = crowds()[crowd], pinhole(40, 20)
    batch = gaussians(len(depths), 74, spread=0.4, log_scales=(-1.5, -0.5), opacity=(0.01, 0.03))
    aside = batch.means[:, :2] / batch.means[:, 2:] * depths[:, None]
    scales = batch.log_scales + (depths / 2).log()[:, None]  # the same size in the image
    batch = replace(batch, means=torch.cat([aside, depths[:, None]], 1), log_scales=scales)
    background = torch.zeros(3, dtype=torch.float64)
    ours = rasterize(batch, camera, background, threads=2)
    oracle = reference.rasterize(batch, camera, background)
    assert ours.color.amax() > 0.3
    torch.testing.assert_close(ours.color, oracle.color, rtol=0, atol=1e-12)


def test_other_outputs_have_the_same_bits_without_depth(isa: str) -> None:
    batch, camera = gaussians(300, 75, log_scales=(-3.0, -1.0)), pinhole(50, 40)
    for dtype in (torch.float32, torch.float64):
        images = []
        for depth in (True, False):
            leaf = batch.means.to(dtype).requires_grad_()
            result = rasterize(
                replace(cast(batch, dtype), means=leaf), camera, torch.ones(3, dtype=dtype), depth=depth, threads=2
            )
            (result.color.square().sum() + result.alpha.square().sum()).backward()
            images.append((result.color, result.alpha, result.means2d, result.radii, leaf.grad))
            assert (result.depth is not None) == depth
        assert all(torch.equal(first, second) for first, second in zip(*images, strict=True))


def test_an_image_with_more_blocks_than_16_bits_count_is_refused() -> None:
    batch, background = gaussians(3, 76), torch.zeros(3, dtype=torch.float64)
    for width, height in ((1, 262145), (262145, 1)):
        with pytest.raises(ValueError, match="at most 262144 pixels"):
            rasterize(batch, pinhole(width, height), background)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("length", [1e0, 1e1, 1e2, 1e3, 1e4, 1e5])
def test_lists_of_tiles_and_blocks_never_cut_a_footprint(length: float, dtype: torch.dtype, isa: str) -> None:
    """The image equals the one without lists, thresholded at alpha_min."""
    camera = pinhole(200, 150, focal=100.0)
    batch = gaussians(40, 70, spread=0.8, depth=(2.0, 2.0), opacity=(0.02, 0.9))
    scales = torch.tensor([1.0, 1e-6, 1e-3], dtype=torch.float64) * length * 2.0 / camera.fx
    batch = replace(batch, log_scales=scales.log().expand(40, 3).clone(), colors=torch.ones_like(batch.colors))
    # half of them nearly along the rows of pixels: the steepest shear there is
    turns = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64) + 1e-3 * batch.quats[:20]
    batch = cast(replace(batch, quats=torch.cat([turns, batch.quats[20:]])), dtype)
    background = torch.zeros(3, dtype=dtype)
    everywhere = RasterSettings(alpha_min=0.0, transmittance_min=0.0)
    for i in range(len(batch)):
        alone = rows(batch, torch.tensor([i]))
        raw = rasterize(alone, camera, background, settings=everywhere, threads=1).color[..., 0]
        ours = rasterize(alone, camera, background, settings=DEFAULT_SETTINGS, threads=1).color[..., 0]
        least = torch.tensor(DEFAULT_SETTINGS.alpha_min, dtype=dtype)
        assert torch.equal(ours, torch.where(raw >= least, raw, 0.0)), i


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_previous_memory_contents_do_not_matter_behind_the_stop_or_without_upstream_gradient(
    dtype: torch.dtype, dirty_memory: None
) -> None:
    """Entries that no pixel reached, and tiles without an upstream, have no sums that could be read."""
    batch, camera = gaussians(300, 71, spread=0.05, log_scales=(0.5, 1.0), opacity=(0.9, 0.95)), pinhole(40, 24)
    silent = upstream(camera)
    silent[:, 16:] = 0
    for cotangent in (upstream(camera), silent, torch.zeros_like(silent)):
        gradients = draw(rasterize, cast(batch, dtype), camera, cotangent).gradients
        assert all(gradient.isfinite().all() for gradient in gradients.values())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_line_through_the_corners_of_blocks_is_drawn(dtype: torch.dtype, isa: str) -> None:
    """A needle thinner than rounding, along the diagonal: only the slack keeps blocks that it touches at one corner."""
    camera = pinhole(64, 64, focal=128.0)
    random = torch.Generator().manual_seed(72)
    background = torch.zeros(3, dtype=dtype)
    least = torch.tensor(DEFAULT_SETTINGS.alpha_min, dtype=dtype)
    met = 0
    for i in range(300):
        aside, width, angle = torch.rand(3, generator=random, dtype=torch.float64).tolist()
        angle = math.pi / 8 + 1e-7 * (2 * angle - 1)
        thin = replace(DEFAULT_SETTINGS, blur=1e-12 * (1 + width))
        everywhere = replace(thin, alpha_min=0.0, transmittance_min=0.0)
        # px beside the diagonal: right of the corners, where alpha falls to 1/255
        aside = 3 + math.sqrt(1 + width) * (4.2e-6 + 1e-6 * aside)
        one = Gaussians(
            means=torch.tensor([[aside / 64, 0.0, 2.0]], dtype=dtype),
            quats=torch.tensor([[math.cos(angle), 0.0, 0.0, math.sin(angle)]], dtype=dtype),
            log_scales=torch.tensor([[5.0, -25.0, -25.0]], dtype=dtype),
            opacities=torch.tensor([0.9], dtype=dtype),
            colors=torch.ones(1, 3, dtype=dtype),
            uids=torch.zeros(1, dtype=torch.int64),
        )
        raw = rasterize(one, camera, background, settings=everywhere, threads=1).color[..., 0]
        ours = rasterize(one, camera, background, settings=thin, threads=1).color[..., 0]
        assert torch.equal(ours, torch.where(raw >= least, raw, 0.0)), i
        met += int((ours > 0).sum())
    assert met > 100


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("period", [8, 16, 32, 64])
def test_gaussians_between_inactive_ones_keep_their_gradients(period: int, dtype: torch.dtype, isa: str) -> None:
    """One Gaussian in `period` has an upstream gradient; skipped entries in between must not overwrite its data."""
    count = 5 * period
    active = torch.arange(count) % period == 0
    batch, camera = gaussians(count, 77, log_scales=(-3.5, -3.2), opacity=(0.1, 0.3)), pinhole(16, 16)
    depths = torch.linspace(2.0, 2.5, count, dtype=torch.float64)
    aside = torch.where(active, -0.14, 0.14).double() * depths  # the first block of the tile, or the last
    batch = replace(batch, means=torch.stack([aside, aside, depths], 1))
    cotangent = upstream(camera)
    cotangent[4:], cotangent[:, 4:] = 0, 0
    ours = draw(rasterize, cast(batch, dtype), camera, cotangent).gradients
    oracle = draw(reference.rasterize, batch, camera, cotangent).gradients
    assert (oracle["means"][active].norm(dim=1) > 1e-3).all()
    assert (oracle["means"][~active] == 0).all()
    for name, expected in oracle.items():
        assert relative(ours[name], expected) < (1e-12 if dtype == torch.float64 else 1e-5), name
