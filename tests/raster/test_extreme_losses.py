"""The photometric loss on extreme images: flat, black against white, non-finite, equal to their target."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from graings.constants import SSIM_C2
from graings.raster.photometric import photometric, ssim
from graings.raster.rasterize import rasterize
from tests.raster.comparison import BACKGROUND, UNIT_ROUNDOFF
from tests.scenes import FLOATS, cast, overlapping

WEIGHT = 0.2


def loss_and_gradient(image: Tensor, target: Tensor, weight: float = WEIGHT) -> tuple[Tensor, Tensor]:
    leaf = image.clone().requires_grad_()
    value = photometric(leaf, target, weight)
    (gradient,) = torch.autograd.grad(value, leaf)
    return value.detach(), gradient


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", [0.0, 0.6, 1.0])
def test_nearly_equal_flat_images_have_no_loss(level: float, dtype: torch.dtype, isa: str) -> None:
    """Flat images that nearly agree; E[x^2] - E[x]^2 is below 0 for some of them."""
    image = torch.full((24, 24, 3), level, dtype=dtype)
    for target in (image, image + 1e-7):
        value, gradient = loss_and_gradient(image, target)
        assert 0 <= value.item() <= 1
        assert gradient.isfinite().all()
        if dtype == torch.float64:
            assert abs(ssim(image, target).item() - 1) < 1e-9


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (17, 33)])
def test_black_against_white_has_the_largest_loss_and_a_finite_gradient(
    size: tuple[int, int], dtype: torch.dtype, isa: str
) -> None:
    """The largest possible loss."""
    black, white = torch.zeros(*size, 3, dtype=dtype), torch.ones(*size, 3, dtype=dtype)
    for image, target in ((black, white), (white, black)):
        value, gradient = loss_and_gradient(image, target)
        assert 0.99 <= value.item() <= 1
        assert gradient.isfinite().all()
        assert (gradient * (target - image)).sum() < 0  # a step towards the target reduces the loss


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("where", ["image", "target"])
@pytest.mark.parametrize("weight", [0.0, WEIGHT, 1.0])
def test_a_non_finite_pixel_gives_a_non_finite_loss(weight: float, where: str, bad: float, isa: str) -> None:
    """A finite loss of an image with a hole would hide the hole from checks of the loss."""
    image, target = torch.full((20, 20, 3), 0.4), torch.full((20, 20, 3), 0.5)
    (image if where == "image" else target)[7, 9, 1] = bad
    value, _ = loss_and_gradient(image, target, weight)
    assert not value.isfinite()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("weight", [0.0, WEIGHT, 1.0])
def test_an_image_equal_to_its_target_has_no_gradient(weight: float, dtype: torch.dtype, isa: str) -> None:
    """The gradient of L1 is exactly 0 there, and that of SSIM up to the rounding of its terms."""
    batch, camera = overlapping()
    batch = cast(batch, dtype)
    leaves = {name: getattr(batch, name).clone().requires_grad_() for name in FLOATS}
    color = rasterize(replace(batch, **leaves), camera, torch.tensor(BACKGROUND, dtype=dtype)).color
    color.retain_grad()
    value = photometric(color, color.detach(), weight)
    value.backward()
    assert color.grad is not None
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    assert all(gradient.isfinite().all() for gradient in gradients.values())
    if weight == 0:
        assert value.item() == 0
        assert all((gradient == 0).all() for gradient in gradients.values())
    # 24 roundings of moments <= 1, seen through the smallest divisor C2, as in `test_photometric`
    bound = 24 * (UNIT_ROUNDOFF if dtype == torch.float32 else 2.0**-53) / SSIM_C2
    assert abs(value.item()) <= weight * bound
    # what one grey level of noise would send back is the measure of a gradient that should not be there
    noise = torch.randn(color.shape, generator=torch.Generator().manual_seed(0), dtype=dtype) / 255
    _, usual = loss_and_gradient(color.detach() + noise, color.detach(), weight)
    assert color.grad.norm() <= bound * usual.norm()
