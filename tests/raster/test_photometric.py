"""The fused photometric loss: equal to plain torch, the same bits for any number of threads, in range where clamped."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from graings import kernel
from graings.constants import SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from graings.raster import photometric_reference
from graings.raster.photometric import photometric, ssim
from tests.raster.comparison import UNIT_ROUNDOFF, relative

SIZES = [(1, 1), (1, 7), (5, 5), (17, 33), (33, 47), (40, 3)]


def pair(height: int, width: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(height * 1000 + width)
    target = torch.rand(height, width, 3, generator=random, dtype=torch.float64)
    image = (target + 0.1 * torch.randn(height, width, 3, generator=random, dtype=torch.float64)).clamp(0, 1)
    return image.to(dtype), target.to(dtype)


def with_gradient(
    function: Callable[..., Tensor], image: Tensor, target: Tensor, **options: Any
) -> tuple[Tensor, Tensor]:
    leaf = image.clone().requires_grad_()
    value = function(leaf, target, **options)
    (gradient,) = torch.autograd.grad(value, leaf)
    return value.detach(), gradient


def test_the_kernel_is_compiled_with_the_constants_of_ssim() -> None:
    constants = kernel.kernel().ssim_constants()
    assert (constants["c1"], constants["c2"]) == (SSIM_C1, SSIM_C2)
    distances = torch.arange(SSIM_WINDOW // 2 + 1, dtype=torch.float64)
    taps = torch.exp(-distances.square() / (2 * SSIM_SIGMA**2))
    taps /= taps[0] + 2 * taps[1:].sum()
    torch.testing.assert_close(torch.tensor(constants["taps"], dtype=torch.float64), taps, rtol=1e-15, atol=0)


@pytest.mark.parametrize("size", SIZES)
def test_double_precision_equals_a_plain_convolution(size: tuple[int, int], isa: str) -> None:
    value, gradient = with_gradient(ssim, *pair(*size))
    expected, expected_gradient = with_gradient(photometric_reference.ssim, *pair(*size))
    torch.testing.assert_close(value, expected, rtol=0, atol=1e-12)
    assert relative(gradient, expected_gradient) < 1e-12


@pytest.mark.parametrize("size", SIZES)
def test_single_precision_stays_close_to_double(size: tuple[int, int], isa: str) -> None:
    image, target = pair(*size, torch.float32)
    value, gradient = with_gradient(ssim, image, target)
    expected, expected_gradient = with_gradient(photometric_reference.ssim, image.double(), target.double())
    # Two passes of 11 products in [0, 1]: 24 roundings of moments <= 1, seen through the smallest divisor C2 = 9e-4.
    bound = 24 * UNIT_ROUNDOFF / SSIM_C2
    assert abs(value.double() - expected).item() <= bound
    assert relative(gradient, expected_gradient) <= bound


@pytest.mark.parametrize("squared", [0.0, 7.0])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("size", SIZES)
def test_the_weighted_loss_equals_the_reference(size: tuple[int, int], weight: float, squared: float, isa: str) -> None:
    image, target = pair(*size)
    if image.numel() > 3:
        image[0, 0] = target[0, 0]  # the gradient of |x| at 0 is 0

    def ours(x: Tensor, y: Tensor) -> Tensor:
        return photometric(x, y, weight, squared)

    def plain(x: Tensor, y: Tensor) -> Tensor:
        return photometric_reference.photometric(x, y, weight, squared)

    value, gradient = with_gradient(ours, image, target)
    expected, expected_gradient = with_gradient(plain, image, target)
    torch.testing.assert_close(value, expected, rtol=0, atol=1e-12)
    assert relative(gradient, expected_gradient) < 1e-12


@pytest.mark.parametrize("threads", [2, 4])
def test_any_number_of_threads_gives_the_same_bits(threads: int) -> None:
    image, target = pair(70, 41, torch.float32)
    one, many = (with_gradient(ssim, image, target, threads=n) for n in (1, threads))
    assert torch.equal(one[0], many[0])
    assert torch.equal(one[1], many[1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", [0.0, 0.6, 1.0])
def test_flat_images_stay_in_range(level: float, dtype: torch.dtype) -> None:
    image = torch.full((20, 20, 3), level, dtype=dtype)
    value, gradient = with_gradient(ssim, image, image + 1e-7)
    assert -1 <= value.item() <= 1
    assert gradient.isfinite().all()


def test_identical_images_have_similarity_one() -> None:
    image, _ = pair(20, 20)
    value, gradient = with_gradient(ssim, image, image)
    torch.testing.assert_close(value.item(), 1.0, rtol=0, atol=1e-12)
    assert gradient.abs().max().item() < 1e-12


def box(rows: slice, columns: slice) -> Callable[[Tensor, Tensor], Tensor]:
    def inside(y: Tensor, x: Tensor) -> Tensor:
        return (y >= rows.start) & (y < rows.stop) & (x >= columns.start) & (x < columns.stop)

    return inside


@pytest.mark.parametrize("level", [1.0, 0.5, None])  # a flat surrounding, or one with structure
@pytest.mark.parametrize(
    "differs",
    [
        box(slice(0, 1), slice(0, 1)),
        box(slice(20, 31), slice(15, 40)),
        box(slice(59, 60), slice(0, 50)),
        box(slice(0, 60), slice(49, 50)),
        box(slice(8, 9), slice(30, 31)),
        box(slice(30, 30), slice(0, 0)),
        pytest.param(lambda y, x: (x - 45 + y).abs() < 2, id="a slanted stripe"),
        pytest.param(lambda y, x: (y - 12) * (y - 47) + x * (x - 49) == 0, id="the outline of a rectangle"),
        pytest.param(lambda y, x: (y % 23 == 4) & (x == 3 * (y // 23)), id="rows without differences between others"),
    ],
)
def test_skipping_equal_pixels_does_not_change_the_loss(
    differs: Callable[[Tensor, Tensor], Tensor], level: float | None, isa: str
) -> None:
    image, target = pair(60, 50)
    if level is not None:
        target = torch.full_like(target, level)
    different = differs(torch.arange(60)[:, None], torch.arange(50)[None, :])[..., None]
    image = torch.where(different, image, target)
    for ours, plain in (
        (ssim, photometric_reference.ssim),
        (lambda x, y: photometric(x, y, 0.2, 3.0), lambda x, y: photometric_reference.photometric(x, y, 0.2, 3.0)),
    ):
        value, gradient = with_gradient(ours, image, target)
        expected, expected_gradient = with_gradient(plain, image, target)
        torch.testing.assert_close(value, expected, rtol=0, atol=1e-12)
        # The oracle's own rounding in equal parts: 24 moments <= 1 through the smallest divisor C2, in float64.
        noise = 24 * 2.0**-53 / SSIM_C2 / image.numel()
        assert ((gradient - expected_gradient).abs() <= 1e-12 * expected_gradient.abs().max() + noise).all()


def test_nan_counts_as_a_difference() -> None:
    image, _ = pair(40, 40)
    target = image.clone()
    image[20, 20, 1] = torch.nan
    value, gradient = with_gradient(ssim, image, target)
    assert value.isnan()
    assert gradient[20, 20].isnan().any()


def test_gradcheck_passes() -> None:
    image, target = pair(6, 5)
    assert torch.autograd.gradcheck(lambda x: ssim(x, target), image.clone().requires_grad_())


def test_misuse_is_refused_by_name() -> None:
    image, target = pair(4, 4)
    with pytest.raises(ValueError, match=r"image must have shape \(H, W, 3\)"):
        ssim(image[..., 0], target)
    with pytest.raises(ValueError, match="target must have the shape of image"):
        ssim(image, target[:2])
    with pytest.raises(ValueError, match="must both be float32 or float64"):
        ssim(image, target.float())
    with pytest.raises(ValueError, match="target must not require a gradient"):
        ssim(image, target.clone().requires_grad_())


@pytest.mark.parametrize("module", [photometric_reference.photometric, photometric])
def test_masked_pixels_change_neither_value_nor_gradient(module: Callable[..., Tensor]) -> None:
    image, target = pair(33, 47)
    valid = torch.zeros(33, 47, dtype=torch.bool)
    valid[5:30, 8:40] = True
    valid[10:14, 12:16] = False
    value, gradient = with_gradient(module, image, target, ssim_weight=0.2, squared_weight=3.0, valid=valid)
    assert gradient[~valid].abs().max() == 0
    assert (gradient[valid] != 0).all()
    other = torch.where(valid.unsqueeze(-1), target, torch.rand_like(target))
    again, gradient_too = with_gradient(module, image, other, ssim_weight=0.2, squared_weight=3.0, valid=valid)
    assert torch.equal(value, again)
    assert torch.equal(gradient, gradient_too)


def test_without_similarity_the_masked_loss_is_the_mean_over_valid_pixels() -> None:
    image, target = pair(17, 33)
    valid = torch.rand(17, 33, generator=torch.Generator().manual_seed(0)) > 0.4
    value = photometric(image, target, 0.0, 2.0, valid=valid)
    difference = (image - target)[valid]
    torch.testing.assert_close(value, difference.abs().mean() + 2.0 * difference.square().mean(), rtol=1e-12, atol=0)


def test_far_from_a_mask_similarity_is_that_of_the_valid_part() -> None:
    image, target = pair(40, 60)
    target[:, :30] = image[:, :30]  # the masked half differs by nothing in the whole image either
    valid = torch.ones(40, 60, dtype=torch.bool)
    valid[:, :30] = False
    masked = photometric(image, target, 1.0, valid=valid)
    torch.testing.assert_close(masked, 2 * photometric(image, target, 1.0), rtol=1e-12, atol=0)


def test_the_loss_of_an_image_without_a_valid_pixel_is_zero() -> None:
    image, target = pair(5, 5)
    valid = torch.zeros(5, 5, dtype=torch.bool)
    value, gradient = with_gradient(photometric, image, target, ssim_weight=0.2, squared_weight=1.0, valid=valid)
    assert value.abs() < 1e-15
    assert gradient.abs().max() == 0


def test_both_implementations_agree_with_a_mask(isa: str) -> None:
    image, target = pair(33, 47)
    valid = torch.rand(33, 47, generator=torch.Generator().manual_seed(1)) > 0.3
    options = {"ssim_weight": 0.4, "squared_weight": 1.5, "valid": valid}
    value, gradient = with_gradient(photometric, image, target, **options)
    expected, expected_gradient = with_gradient(photometric_reference.photometric, image, target, **options)
    torch.testing.assert_close(value, expected, rtol=0, atol=1e-12)
    assert relative(gradient, expected_gradient) < 1e-11
