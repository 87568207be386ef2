"""Properties that hold to the last bit: threads, order of rows, isolation of non-finite Gaussians, empty images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from graings.camera.camera import Camera
from graings.gaussians import Gaussians
from graings.raster.rasterize import rasterize
from graings.raster.result import RasterSettings, RenderResult
from tests.raster.comparison import BACKGROUND, UNIT_ROUNDOFF, Drawing, draw, upstream
from tests.scenes import FLOATS, cast, deep_stack, gaussians, overlapping, pinhole, rows, wide

IMAGES = ("color", "alpha", "depth")
ROW_GRADIENTS = (*FLOATS, "means2d_offset")


def assert_same_bits(first: Drawing, second: Drawing) -> None:
    for name, image in first.images().items():
        assert torch.equal(image, second.images()[name]), name
    for name, gradient in first.gradients.items():
        assert torch.equal(gradient, second.gradients[name]), name


def render_view(batch: Gaussians, camera: Camera, *, settings: RasterSettings | None = None) -> RenderResult:
    background = torch.tensor(BACKGROUND, dtype=batch.means.dtype)
    return rasterize(batch, camera, background, settings=settings or RasterSettings(), threads=1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("threads", [2, 4])
def test_any_number_of_threads_gives_the_same_bits(threads: int, dtype: torch.dtype) -> None:
    batch = gaussians(1500, 20, spread=0.7, log_scales=(-4.0, -1.0))
    camera = pinhole(90, 70, focal=60.0)
    one = draw(rasterize, cast(batch, dtype), camera, upstream(camera), threads=1)
    for _ in range(3):
        assert_same_bits(one, draw(rasterize, cast(batch, dtype), camera, upstream(camera), threads=threads))


def test_no_state_is_carried_over_from_another_view() -> None:
    batch, camera = overlapping()
    first = draw(rasterize, batch, camera, upstream(camera))
    draw(rasterize, *wide(), upstream(camera))
    assert_same_bits(first, draw(rasterize, batch, camera, upstream(camera)))


def test_coincident_gaussians_are_ordered_by_uid_not_by_row() -> None:
    batch = gaussians(40, 21)
    batch = replace(batch, means=batch.means[:4].repeat_interleave(10, 0))
    shuffle = torch.randperm(40, generator=torch.Generator().manual_seed(0))
    camera = pinhole()
    first = draw(rasterize, batch, camera, upstream(camera))
    second = draw(rasterize, rows(batch, shuffle), camera, upstream(camera))
    for name, image in first.images().items():
        assert torch.equal(image, second.images()[name])
    for name in ROW_GRADIENTS:
        assert torch.equal(first.gradients[name][shuffle], second.gradients[name]), name


def test_slabs_of_equal_depth_are_ordered_by_uid_not_by_row() -> None:
    x, y, z = torch.meshgrid(torch.arange(20.0), torch.arange(20.0), torch.arange(3.0), indexing="ij")
    grid = torch.stack([(x - 9.5) / 16, (y - 9.5) / 16, 2 + z / 16], -1).reshape(-1, 3).double()
    batch = replace(gaussians(len(grid), 22, log_scales=(-3.0, -2.0)), means=grid)
    shuffle = torch.randperm(len(grid), generator=torch.Generator().manual_seed(1))
    first, second = render_view(batch, pinhole()), render_view(rows(batch, shuffle), pinhole())
    assert all(torch.equal(getattr(first, name), getattr(second, name)) for name in IMAGES)


def test_uids_decide_the_order_at_equal_depth() -> None:
    batch = gaussians(2, 23, spread=0.0, opacity=(0.9, 0.9))
    batch = replace(batch, means=batch.means[:1].repeat(2, 1), uids=torch.tensor([7, 3]))
    camera = pinhole(15, 15)
    nearest = render_view(batch, camera).color[7, 7]
    swapped = render_view(replace(batch, uids=torch.tensor([3, 7])), camera).color[7, 7]
    assert (nearest - batch.colors[1]).norm() < (nearest - batch.colors[0]).norm()
    assert (swapped - batch.colors[0]).norm() < (swapped - batch.colors[1]).norm()


def test_the_sign_of_a_quaternion_does_not_matter() -> None:
    batch, camera = overlapping()
    first, second = render_view(batch, camera), render_view(replace(batch, quats=-batch.quats), camera)
    assert all(torch.equal(getattr(first, name), getattr(second, name)) for name in IMAGES)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", FLOATS)
def test_a_non_finite_gaussian_is_culled_and_affects_nothing_else(field: str, bad: float, dtype: torch.dtype) -> None:
    batch, camera = cast(overlapping()[0], dtype), overlapping()[1]
    poisoned = getattr(batch, field).clone()
    poisoned.view(len(batch), -1)[17, -1] = bad
    others = torch.tensor([i for i in range(len(batch)) if i != 17])
    ours = draw(rasterize, replace(batch, **{field: poisoned}), camera, upstream(camera))
    clean = draw(rasterize, rows(batch, others), camera, upstream(camera))
    for name, image in ours.images().items():
        assert torch.equal(image, clean.images()[name])
    for name in ROW_GRADIENTS:
        assert torch.equal(ours.gradients[name][others], clean.gradients[name]), name
        assert (ours.gradients[name][17] == 0).all(), name
    assert ours.result.culled["non_finite"] == clean.result.culled["non_finite"] + 1
    assert (ours.result.radii[17] == 0).all()


@pytest.mark.parametrize("value", [0.0, -0.0, 1e-40, 1e20, -1e20, 1e38, 3.4e38])
@pytest.mark.parametrize("field", FLOATS)
def test_extreme_but_finite_values_leave_everything_finite(field: str, value: float) -> None:
    batch, camera = cast(overlapping()[0], torch.float32), overlapping()[1]
    extreme = getattr(batch, field).clone()
    extreme.view(len(batch), -1)[5] = value
    drawing = draw(rasterize, replace(batch, **{field: extreme}), camera, upstream(camera))
    if field != "colors":  # a colour of 1e38 may well overflow the pixel it is drawn on
        assert all(image.isfinite().all() for image in drawing.images().values())
        assert all(gradient.isfinite().all() for gradient in drawing.gradients.values())


def test_every_reason_for_culling_is_counted_once() -> None:
    batch = gaussians(7, 24, spread=0.1)
    means, quats, opacities = batch.means.clone(), batch.quats.clone(), batch.opacities.clone()
    means[0, 0] = math.nan
    quats[1] = 0
    means[2, 2] = -1
    opacities[3] = 1 / 255
    means[4, 0] = 1e8
    batch = replace(batch, means=means, quats=quats, opacities=opacities)
    culled = render_view(batch, pinhole()).culled
    assert culled == {"non_finite": 1, "zero_quat": 1, "behind": 1, "faint": 1, "outside": 1}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scene", ["none", "all_behind", "all_zero_quat"])
def test_an_empty_image_is_the_background_with_zero_gradients(scene: str, dtype: torch.dtype) -> None:
    batch = cast(gaussians(0 if scene == "none" else 5, 25), dtype)
    if scene == "all_behind":
        batch = replace(batch, means=-batch.means)
    if scene == "all_zero_quat":
        batch = replace(batch, quats=torch.zeros_like(batch.quats))
    camera = pinhole(17, 9)
    drawing = draw(rasterize, batch, camera, upstream(camera))
    assert torch.equal(drawing.result.color, torch.tensor(BACKGROUND, dtype=dtype).expand(9, 17, 3))
    assert (drawing.result.alpha == 0).all()
    assert (drawing.result.depth == 0).all()
    for name in ROW_GRADIENTS:
        expected = (len(batch), 2) if name == "means2d_offset" else getattr(batch, name).shape
        assert drawing.gradients[name].shape == expected
        assert (drawing.gradients[name] == 0).all()


@pytest.mark.parametrize("opacity", [-0.5, 0.0, float(np.nextafter(1 / 255, 0)), 1 / 255])
def test_an_opacity_at_or_below_the_smallest_alpha_is_not_drawn(opacity: float) -> None:
    batch = replace(gaussians(1, 26, spread=0.0), opacities=torch.tensor([opacity], dtype=torch.float64))
    assert render_view(batch, pinhole()).culled["faint"] == 1


def test_alpha_is_capped() -> None:
    batch = gaussians(1, 27, spread=0.0, log_scales=(0.0, 0.0), opacity=(1.1, 1.1))
    assert render_view(batch, pinhole(5, 5)).alpha.max().item() == 0.99


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_colour_everywhere_stays_that_colour(dtype: torch.dtype) -> None:
    batch, camera = deep_stack()
    batch = cast(replace(batch, colors=torch.full_like(batch.colors, 0.5)), dtype)
    color = rasterize(batch, camera, torch.full((3,), 0.5, dtype=dtype)).color
    unit = UNIT_ROUNDOFF if dtype == torch.float32 else 2.0**-53
    assert (color - 0.5).abs().max().item() <= (32 + 4 * math.sqrt(500)) * unit


def test_the_last_gaussian_before_the_stop_is_blended() -> None:
    """Inclusive stop: at most 1e-4 of the light is missing; without the last Gaussian up to 1e-2 is."""
    batch = gaussians(4, 28, spread=0.0, depth=(2.0, 3.0), log_scales=(2.0, 2.0), opacity=(0.95, 0.95))
    camera = pinhole(3, 3)
    untruncated = render_view(batch, camera, settings=RasterSettings(transmittance_min=0.0)).alpha
    inclusive = render_view(batch, camera).alpha
    exclusive = render_view(batch, camera, settings=RasterSettings(compat=True)).alpha
    assert (untruncated - inclusive).max().item() <= 1e-4
    assert (untruncated - exclusive).max().item() > 1e-4


def test_unused_outputs_need_no_gradient() -> None:
    batch, camera = overlapping()
    leaf = batch.means.clone().requires_grad_()
    background = torch.ones(3, dtype=torch.float64)
    for name in IMAGES:
        (gradient,) = torch.autograd.grad(
            getattr(rasterize(replace(batch, means=leaf), camera, background), name).sum(), leaf
        )
        assert gradient.abs().sum() > 0


def test_lazily_negated_and_zero_tensors_are_resolved() -> None:
    """The kernel reads memory, where a lazily negated tensor has the wrong sign and a zero tensor has no data."""
    batch, camera = gaussians(50, 30), pinhole()
    means = batch.means.clone().requires_grad_()
    color = render_view(replace(batch, means=means), camera).color
    assert torch.equal(render_view(replace(batch, means=torch._neg_view(-batch.means)), camera).color, color)
    cotangent = upstream(camera)[..., :3]
    (expected,) = torch.autograd.grad(color, means, cotangent, retain_graph=True)
    (negated,) = torch.autograd.grad(color, means, torch._neg_view(-cotangent), retain_graph=True)
    assert torch.equal(expected, negated)
    assert expected.abs().amax() > 0
    (zero,) = torch.autograd.grad(color, means, torch._efficientzerotensor(color.shape, dtype=color.dtype))
    assert (zero == 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_retained_graph_gives_the_same_gradient_every_time(dtype: torch.dtype) -> None:
    """The first backward pass frees the state of the forward pass; a second one draws the image again."""
    batch, camera = cast(gaussians(50, 31), dtype), pinhole()
    leaves = {name: getattr(batch, name).clone().requires_grad_() for name in FLOATS}
    background = torch.tensor(BACKGROUND, dtype=dtype).requires_grad_()
    ends = [*leaves.values(), background]

    def gradients(images: Sequence[Tensor], seed: int) -> tuple[Tensor, ...]:
        cotangent = upstream(camera, seed).to(dtype)
        return torch.autograd.grad(
            images, ends, [cotangent[..., :3], *cotangent[..., 3:].unbind(-1)], retain_graph=True
        )

    def images() -> tuple[Tensor, Tensor, Tensor]:
        result = rasterize(replace(batch, **leaves), camera, background)
        assert result.depth is not None
        return result.color, result.alpha, result.depth

    kept = images()
    for seed in (0, 1, 0):
        for again, first in zip(gradients(kept, seed), gradients(images(), seed), strict=True):
            assert torch.equal(again, first)
            assert first.abs().sum() > 0


def test_threads_that_differentiate_one_graph_concurrently_get_the_same_gradient() -> None:
    batch, camera = cast(gaussians(2_000, 32), torch.float32), pinhole()
    leaves = {name: getattr(batch, name).clone().requires_grad_() for name in FLOATS}
    color = rasterize(replace(batch, **leaves), camera, torch.tensor(BACKGROUND)).color
    cotangent = upstream(camera).float()[..., :3]

    def gradients() -> tuple[Tensor, ...]:
        return torch.autograd.grad(color, list(leaves.values()), cotangent, retain_graph=True)

    with ThreadPoolExecutor(4) as pool:
        results = [future.result() for future in [pool.submit(gradients) for _ in range(40)]]
    for name, *copies in zip(leaves, *results, strict=True):
        assert copies[0].abs().sum() > 0, name
        assert all(torch.equal(copy, copies[0]) for copy in copies[1:]), name


def test_drawing_works_in_inference_mode() -> None:
    batch, camera = overlapping()
    background = torch.tensor(BACKGROUND, dtype=torch.float64)
    with torch.inference_mode():
        image = rasterize(batch, camera, background).color
    assert torch.equal(image.clone(), rasterize(batch, camera, background).color)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"background": torch.ones(4, dtype=torch.float64)}, r"background must have shape \(3,\), got \(4,\)"),
        ({"background": torch.ones(3)}, "background must be torch.float64 like the Gaussians"),
        ({"means2d_offset": torch.zeros(3, 2, dtype=torch.float64)}, r"means2d_offset must have shape \(60, 2\)"),
        ({"threads": 0}, "threads must be at least 1, got 0"),
    ],
)
def test_misuse_is_refused_by_name(arguments: dict[str, object], message: str) -> None:
    batch, camera = overlapping()
    background: Tensor = torch.ones(3, dtype=torch.float64)
    with pytest.raises(ValueError, match=message):
        rasterize(batch, camera, **{"background": background, **arguments})  # type: ignore[arg-type]
