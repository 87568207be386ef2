"""Gaussians and cameras with extreme values: scales, opacities, non-finite numbers, near plane, deep stacks, gradients.

Further extreme scenes are in `test_agreement` and `test_invariants`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from decimal import Decimal, localcontext

import numpy as np
import pytest
import torch
from torch import Tensor

from graings.camera.camera import Camera
from graings.constants import ALPHA_MAX, ALPHA_MIN, BLUR, NEAR
from graings.gaussians import Gaussians
from graings.raster import reference
from graings.raster.rasterize import rasterize
from graings.raster.result import DEFAULT_SETTINGS, RenderResult
from tests.raster.comparison import BACKGROUND, draw, relative, upstream
from tests.raster.evidence import within
from tests.raster.extremes import SMOOTH, assert_single_precision_holds, central_differences, forward_bound
from tests.scenes import FLOATS, cast, gaussians, pinhole, rows

DTYPES = [torch.float32, torch.float64]
SLOTS = [(field, column) for field, width in zip(FLOATS, (3, 4, 3, 1, 3), strict=True) for column in range(width)]

# up to here a log-scale is drawn; e^45 px across, nothing on the way to the pixels may overflow.
LARGEST_DRAWN = 44.0


def render_view(batch: Gaussians, camera: Camera) -> RenderResult:
    return rasterize(batch, camera, torch.tensor(BACKGROUND, dtype=batch.means.dtype), threads=1)


def one(
    mean: tuple[float, float, float],
    *,
    log_scales: tuple[float, float, float] = (-1.0, -1.0, -1.0),
    opacity: float = 0.5,
) -> Gaussians:
    row = {
        "means": [mean],
        "quats": [(0.9, 0.3, -0.2, 0.4)],
        "log_scales": [log_scales],
        "opacities": [opacity],
        "colors": [(0.7, 0.1, 0.4)],
    }
    return Gaussians(
        **{name: torch.tensor(value, dtype=torch.float64) for name, value in row.items()}, uids=torch.zeros(1).long()
    )


# ---- the sheared footprint


@dataclass(frozen=True, slots=True)
class Footprint:
    determinant: Decimal
    slope: Decimal
    v: Decimal
    c: Decimal


def exact_footprint(mean: Tensor, quat: Tensor, log_scales: Tensor, camera: Camera) -> Footprint:
    """Seen from the origin along +z, by the plain formulas in sixty digits, where no subtraction can hurt."""
    with localcontext() as context:
        context.prec = 60
        x, y, z = (Decimal(value) for value in mean.tolist())
        w, a, b, d = (Decimal(value) for value in quat.tolist())
        scale = [Decimal(value).exp() for value in log_scales.tolist()]
        twice = 2 / (w * w + a * a + b * b + d * d)
        rotation = [
            [1 - twice * (b * b + d * d), twice * (a * b - w * d), twice * (a * d + w * b)],
            [twice * (a * b + w * d), 1 - twice * (a * a + d * d), twice * (b * d - w * a)],
            [twice * (a * d - w * b), twice * (b * d + w * a), 1 - twice * (a * a + b * b)],
        ]
        fx, fy, h = Decimal(camera.fx), Decimal(camera.fy), Decimal(BLUR)
        jacobian = [[fx / z, Decimal(0), -fx * x / (z * z)], [Decimal(0), fy / z, -fy * y / (z * z)]]
        m1, m2 = (
            [sum((row[i] * rotation[i][k] for i in range(3)), Decimal(0)) * scale[k] for k in range(3)]
            for row in jacobian
        )

        def dot(first: list[Decimal], second: list[Decimal]) -> Decimal:
            return sum((p * q for p, q in zip(first, second, strict=True)), Decimal(0))

        c, covariance = dot(m2, m2) + h, dot(m1, m2)
        determinant = (dot(m1, m1) + h) * c - covariance * covariance
        return Footprint(determinant, covariance / c, determinant / c, c)


def needles_of(length: float, count: int) -> tuple[Gaussians, Camera]:
    """Needles `length` px long at most, 1e-6 as thick, turned at random, centred inside the image."""
    camera = pinhole(focal=100.0)
    batch = gaussians(count, int(math.log10(length)), spread=0.15, depth=(2.0, 2.0), opacity=(0.5, 0.5))
    scales = torch.tensor([1.0, 1e-6, 1e-6], dtype=torch.float64) * length * 2.0 / camera.fx
    return replace(batch, log_scales=scales.log().expand(count, 3).clone()), camera


@pytest.mark.parametrize("length", [1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6])
def test_the_footprint_of_a_needle_keeps_ten_digits(length: float) -> None:
    """determinant, slope and conditional variance of the oracle, and the exponent that the kernel draws."""
    batch, camera = needles_of(length, 60)
    offset = torch.zeros(len(batch), 2, dtype=torch.float64)
    prints = reference._project(batch.means, batch.quats, batch.log_scales, offset, camera, DEFAULT_SETTINGS)
    assert (prints.v >= BLUR).all()
    background = torch.zeros(3, dtype=torch.float64)
    pixels = reference._pixel_centres(camera)
    for i in range(len(batch)):
        exact = exact_footprint(batch.means[i], batch.quats[i], batch.log_scales[i], camera)
        measured = (prints.v[i] * prints.c[i], prints.slope[i], prints.v[i])
        for value, expected in zip(measured, (exact.determinant, exact.slope, exact.v), strict=True):
            within("footprint", abs(value.item() - float(expected)) / abs(float(expected)), 1e-10)
        assert exact.determinant > 0
        dx, dy = (pixels - prints.means2d[i]).unbind(1)
        expected_exponent = (dx - float(exact.slope) * dy) ** 2 / (2 * float(exact.v)) + dy**2 / (2 * float(exact.c))
        seen = expected_exponent <= math.log(0.5 / ALPHA_MIN)
        # the blended depth of one Gaussian is alpha Z: no subtraction from 1 in it
        drawn = rasterize(rows(batch, torch.tensor([i])), camera, background, settings=SMOOTH, threads=1).depth
        exponent = -(drawn.reshape(-1)[seen] / (0.5 * batch.means[i, 2])).log()
        error = (exponent - expected_exponent[seen]).abs() / expected_exponent[seen].clamp(min=1.0)
        assert seen.any()
        within("exponent", error.max().item(), 1e-10)


# ---- scales


def test_gaussians_without_extent_have_the_footprint_of_the_low_pass_filter() -> None:
    """All scales are e^-80: only the low-pass filter remains, and no gradient reaches a scale."""
    batch, camera = gaussians(1, 40, spread=0.1, opacity=(0.8, 0.8)), pinhole()
    batch = replace(batch, log_scales=torch.full_like(batch.log_scales, -80.0))
    ours = draw(rasterize, batch, camera, upstream(camera))
    distance = (reference._pixel_centres(camera) - ours.result.means2d[0]).square().sum(1)
    blob = 0.8 * torch.exp(-distance / (2 * BLUR))
    blob = torch.where(blob >= ALPHA_MIN, blob, 0.0).reshape(camera.height, camera.width)
    assert (blob > 0).sum() > 5
    torch.testing.assert_close(ours.result.alpha, blob, rtol=0, atol=forward_bound(1))
    assert ours.gradients["log_scales"].abs().max().item() < 1e-30
    assert ours.gradients["means"].abs().max().item() > 0


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_flat_axis_of_a_disc_has_no_gradient(dtype: torch.dtype) -> None:
    """The scales are (1, 1, e^-80)."""
    batch, camera = cast(gaussians(30, 41), dtype), pinhole()
    log_scales = torch.zeros_like(batch.log_scales)
    log_scales[:, 2] = -80.0
    gradients = draw(rasterize, replace(batch, log_scales=log_scales), camera, upstream(camera)).gradients
    assert all(gradient.isfinite().all() for gradient in gradients.values())
    assert gradients["log_scales"][:, 2].abs().max().item() < 1e-30
    assert gradients["log_scales"][:, :2].abs().max().item() > 0


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("log_scale", [-30.0, -10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 44.0, 60.0, 88.0, 89.0, math.inf])
def test_any_scale_is_drawn_or_culled_and_the_image_stays_finite(log_scale: float, dtype: torch.dtype) -> None:
    """Isotropic and along one axis; drawn at least up to e^44, and culled if not finite."""
    camera = pinhole()
    for axes in (slice(0, 3), slice(1, 2)):
        batch = cast(gaussians(20, 42, log_scales=(-2.0, -1.0)), dtype)
        # in the middle of the image, so that the blob of a tiny one meets a pixel
        means = batch.means.clone()
        means[7] = torch.tensor([0.01, 0.02, 2.5], dtype=dtype)
        log_scales = batch.log_scales.clone()
        log_scales[7, axes] = log_scale
        drawing = draw(rasterize, replace(batch, means=means, log_scales=log_scales), camera, upstream(camera))
        assert all(image.isfinite().all() for image in drawing.images().values())
        assert all(gradient.isfinite().all() for gradient in drawing.gradients.values())
        if log_scale <= LARGEST_DRAWN:
            assert drawing.result.culled["non_finite"] == 0
            assert drawing.result.radii[7].min() > 0
            assert drawing.gradients["opacities"][7] != 0
        if log_scale == math.inf:
            assert drawing.result.culled["non_finite"] == 1


# ---- one poisoned number


@pytest.mark.parametrize(("field", "column"), SLOTS, ids=[f"{field}{column}" for field, column in SLOTS])
def test_an_extreme_or_non_finite_number_affects_only_its_gaussian(field: str, column: int) -> None:
    """For any value of one number of one of 120 Gaussians, all results are finite; if culled, it has no effect."""
    info = torch.finfo(torch.float32)
    values = (math.nan, -math.nan, math.inf, -math.inf, 0.0, -0.0, info.tiny, 1e-40, info.eps, 1e20, -1e20, 1e38, -1e38)
    batch, camera = cast(gaussians(120, 43), torch.float32), pinhole()
    poisoned = 77
    others = torch.tensor([i for i in range(len(batch)) if i != poisoned])
    cotangent = upstream(camera)
    without = draw(rasterize, rows(batch, others), camera, cotangent)
    for value in (*values, info.max, info.min):
        tensor = getattr(batch, field).clone()
        tensor.view(len(batch), -1)[poisoned, column] = value
        drawing = draw(rasterize, replace(batch, **{field: tensor}), camera, cotangent)
        if not math.isfinite(value):
            assert drawing.result.culled["non_finite"] == without.result.culled["non_finite"] + 1, value
        if (drawing.result.radii[poisoned] == 0).all():
            assert sum(drawing.result.culled.values()) == sum(without.result.culled.values()) + 1, value
            assert all(torch.equal(image, without.images()[name]) for name, image in drawing.images().items()), value
            for name in (*FLOATS, "means2d_offset"):
                assert torch.equal(drawing.gradients[name][others], without.gradients[name]), (value, name)
                assert (drawing.gradients[name][poisoned] == 0).all(), (value, name)
        elif field != "colors" or abs(value) < 1e30:  # a colour of 1e38 may well overflow the pixel it is drawn on
            assert all(image.isfinite().all() for image in drawing.images().values()), value
            assert all(gradient.isfinite().all() for gradient in drawing.gradients.values()), value


# ---- thresholds


@pytest.mark.parametrize("dtype", DTYPES)
def test_opacities_around_the_thresholds_are_culled_kept_and_capped(dtype: torch.dtype) -> None:
    """A Gaussian whose centre is the centre of a pixel."""
    scalar = np.float32 if dtype == torch.float32 else np.float64
    least = scalar(ALPHA_MIN)
    below, above = np.nextafter(least, scalar(0)), np.nextafter(least, scalar(1))
    for opacity in (-0.5, 0.0, below, least, above, 0.99, 1.0, 1.1):
        batch = replace(one((0.0, 0.0, 2.0)), opacities=torch.tensor([float(opacity)], dtype=torch.float64))
        drawing = draw(rasterize, cast(batch, dtype), pinhole(15, 15), upstream(pinhole(15, 15)))
        drawn = float(opacity) > ALPHA_MIN  # the nearest float32 to 1/255 is a little more than 1/255
        assert drawing.result.culled["faint"] == (0 if drawn else 1), opacity
        assert all(gradient.isfinite().all() for gradient in drawing.gradients.values()), opacity
        centre, cap = drawing.result.alpha[7, 7].item(), float(scalar(ALPHA_MAX))
        assert drawing.result.alpha.max().item() <= cap
        if not drawn:
            assert (drawing.result.alpha == 0).all(), opacity
        elif opacity > 0.01:
            assert centre == pytest.approx(min(float(opacity), cap), abs=2 * torch.finfo(dtype).eps), opacity
    assert centre == cap


@pytest.mark.parametrize("dtype", DTYPES)
def test_nothing_at_or_behind_the_near_plane_is_drawn(dtype: torch.dtype) -> None:
    """At the camera, one ulp before, on and behind the near plane, behind the camera, far to the side."""
    scalar = np.float32 if dtype == torch.float32 else np.float64
    on = scalar(NEAR)
    camera = pinhole()
    steps = {float(np.nextafter(on, scalar(0))), float(on), float(np.nextafter(on, scalar(1)))}
    for z in (0.0, -0.0, -1.0, -1e-30, *steps):
        drawing = draw(rasterize, cast(one((0.0, 0.0, z)), dtype), camera, upstream(camera))
        assert drawing.result.culled["behind"] == (0 if z > NEAR else 1), z
        assert (drawing.result.alpha.max() > 0) == (z > NEAR), z
        assert all(gradient.isfinite().all() for gradient in drawing.gradients.values()), z
    for log_scale, outside in ((0.0, 1), (25.0, 0)):  # the second is larger than its distance
        aside = one((1e8, 0.0, 1.0), log_scales=(log_scale, log_scale, log_scale))
        drawing = draw(rasterize, cast(aside, dtype), camera, upstream(camera))
        assert drawing.result.culled["outside"] == outside
        assert all(image.isfinite().all() for image in drawing.images().values())
        assert all(gradient.isfinite().all() for gradient in drawing.gradients.values())


# ---- deep stacks


@pytest.mark.parametrize(("copies", "opacity"), [(1000, 0.05), (5000, 0.004)])
def test_weights_and_transmittance_of_a_deep_stack_add_up_to_one(copies: int, opacity: float) -> None:
    """White Gaussians in front of a white background, with and without a stop."""
    batch = rows(one((0.0, 0.0, 2.0), log_scales=(1.0, 1.0, 1.0), opacity=opacity), torch.zeros(copies).long())
    batch = cast(replace(batch, colors=torch.ones(copies, 3).double(), uids=torch.arange(copies)), torch.float32)
    camera = pinhole(4, 4)
    white = rasterize(batch, camera, torch.ones(3), threads=1)
    within("sum of weights and transmittance less 1", (white.color - 1).abs().max().item(), forward_bound(copies))
    assert white.alpha.min().item() >= 0
    assert white.alpha.max().item() <= 1
    exact = reference.rasterize(cast(batch, torch.float64), camera, torch.ones(3, dtype=torch.float64))
    within("float32 alpha", (white.alpha - exact.alpha).abs().max().item(), forward_bound(copies))
    unstopped = rasterize(batch, camera, torch.ones(3), settings=replace(SMOOTH, alpha_min=ALPHA_MIN), threads=1)
    assert (unstopped.alpha - white.alpha).max().item() <= 1e-4 + 2 * forward_bound(copies)


# ---- cameras and gradients


@pytest.mark.parametrize("width", [40, 1000])
@pytest.mark.parametrize("centre", [-1, 0, 2])
def test_very_wide_and_off_centre_cameras_stay_within_the_bounds(width: int, centre: int) -> None:
    """A focal length of 5 px, the principal point up to an image width outside."""
    camera = pinhole(width, 1, focal=5.0, cx=float(centre * width), cy=0.5)
    batch = gaussians(30, 44, log_scales=(-2.0, 0.0))
    # spread over the image, which the principal point has left
    random = torch.Generator().manual_seed(centre + 7)
    columns = torch.rand(30, generator=random, dtype=torch.float64) * width
    means = batch.means.clone()
    means[:, 0] = (columns - camera.cx) / camera.fx * means[:, 2]
    assert_single_precision_holds((replace(batch, means=means), camera))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("share", [1.05, 1.29, 1.31, 3.0, 10.0])
def test_outside_the_image_the_gradient_is_that_of_the_clamped_projection(share: float, axis: int) -> None:
    """At `share` of half the field of view; 1.3 is where the ratio is clamped before the Jacobian."""
    camera = pinhole(24, 16, focal=8.0)
    half = (camera.width, camera.height)[axis] / (2 * camera.fx)
    mean, scales = [0.1, 0.15, 1.1], [0.3, 0.1, 0.5]
    mean[axis] = share * half * mean[2]
    scales[axis] = math.log(0.7 * mean[axis])  # long enough to reach into the image, where differences are accurate
    batch = replace(one(tuple(mean), log_scales=tuple(scales)), quats=torch.tensor([[1.0, 0.05, -0.1, 0.08]]).double())
    cotangent = upstream(camera, 3)
    ours = draw(rasterize, batch, camera, cotangent, settings=SMOOTH).gradients
    differences = central_differences(batch, camera, cotangent)
    oracle = draw(reference.rasterize, batch, camera, cotangent, settings=SMOOTH).gradients
    for name, expected in differences.items():
        within(f"gradient of {name} against differences", relative(ours[name], expected), 1e-7)
        within(f"gradient of {name} against the oracle", relative(ours[name], oracle[name]), 1e-12)
    assert_single_precision_holds((batch, camera))


def test_all_fourteen_gradients_of_a_gaussian_equal_central_differences() -> None:
    camera = pinhole(24, 16, focal=20.0)
    batch = one((0.1, -0.07, 2.0), log_scales=(-1.0, -1.6, -0.6), opacity=0.6)
    cotangent = upstream(camera, 5)
    ours = draw(rasterize, batch, camera, cotangent, settings=SMOOTH).gradients
    differences = central_differences(batch, camera, cotangent)
    numbers = 0
    for name, expected in differences.items():
        torch.testing.assert_close(ours[name], expected, rtol=1e-7, atol=0)
        numbers += expected.numel()
    assert numbers == 14
