"""Highlights: the viewing direction reflected at a learned normal, as an input of the colour head."""

import pytest
import torch
from torch import Tensor

from graings import kernel
from graings.config import SceneConfig
from graings.scene.appearance import CanonicalAppearance
from graings.scene.encoding import direction_encoding, direction_width, plain_direction_encoding, reflected


def _units(rows: int, seed: int) -> torch.Tensor:
    vectors = torch.randn(rows, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return vectors / vectors.norm(dim=-1, keepdim=True)


def test_reflected_directions_obey_the_law_of_reflection() -> None:
    directions, normals = _units(500, 1), _units(500, 2)
    out = reflected(directions, 7.0 * normals)
    # Same length, opposite angle to the normal, same plane; the epsilon is 1e-6 of a squared length of 49.
    torch.testing.assert_close(out.norm(dim=-1), torch.ones(500, dtype=torch.float64), rtol=0, atol=1e-7)
    torch.testing.assert_close((out * normals).sum(-1), -(directions * normals).sum(-1), rtol=0, atol=1e-7)
    triple = torch.linalg.cross(directions, normals, dim=-1)
    torch.testing.assert_close((out * triple).sum(-1), torch.zeros(500, dtype=torch.float64), rtol=0, atol=1e-12)


def test_a_normal_of_zero_length_reflects_nothing_and_its_gradient_is_finite() -> None:
    directions = _units(4, 3).float()
    scales = torch.tensor([[0.0], [1e-30], [1e-3], [1e18]])
    vectors = (scales * _units(4, 4).float()).requires_grad_()
    out = reflected(directions, vectors)
    assert torch.equal(out[:2], directions[:2])
    # At a squared length equal to the epsilon half of the reflection is applied: the result is never longer than 1.
    assert (out.norm(dim=-1) <= 1 + 1e-6).all()
    (gradient,) = torch.autograd.grad(out.sum(), vectors)
    assert gradient.isfinite().all()


def test_gradcheck_of_reflected_passes() -> None:
    vectors = (2.0 * _units(6, 5)).requires_grad_()
    directions = _units(6, 6).requires_grad_()
    assert torch.autograd.gradcheck(reflected, (directions, vectors))


def test_colour_depends_on_the_normal_only_where_reflection_is_on() -> None:
    features = torch.randn(5, 8, generator=torch.Generator().manual_seed(7))
    directions = _units(5, 8).float()
    with_reflection = CanonicalAppearance(SceneConfig(children=3, feature_dim=8, reflection=True), 0.1)
    without = CanonicalAppearance(SceneConfig(children=3, feature_dim=8, reflection=False), 0.1)
    assert without.normal is None
    assert with_reflection.normal is not None

    def colors() -> Tensor:
        return with_reflection.color_logits(with_reflection.color_part(features), directions)

    before = colors()
    with torch.no_grad():
        with_reflection.normal.bias += 1.0
    assert not torch.equal(colors(), before)
    colors().sum().backward()
    assert with_reflection.normal.weight.grad is not None
    assert with_reflection.normal.weight.grad.abs().sum() > 0


def test_surfaces_that_reflect_the_same_direction_have_the_same_input() -> None:
    """Views reflected at different normals into one direction share a highlight: the colour head sees one direction."""
    target = _units(1, 9)
    views = _units(20, 10)
    normals = target - views  # of the plane that reflects each view into the target
    torch.testing.assert_close(reflected(views, 10 * normals), target.expand(20, 3), rtol=0, atol=1e-5)


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_kernel_encodes_directions_and_reflections_as_torch_does(degree: int, dtype: torch.dtype) -> None:
    lengths = torch.logspace(-6, 6, 3000, dtype=torch.float64).unsqueeze(-1)
    directions, normals = _units(3000, 11).to(dtype), (lengths * _units(3000, 12)).to(dtype).requires_grad_()
    encoded = direction_encoding(directions, degree, normals)
    plain_normals = normals.detach().double().requires_grad_()
    expected = plain_direction_encoding(directions.double(), degree, plain_normals)
    # Numbers up to 3, computed in float64 by both and rounded to `dtype`: each may differ in the last place.
    torch.testing.assert_close(encoded.double(), expected, rtol=0, atol=4 * torch.finfo(dtype).eps)
    assert torch.equal(direction_encoding(directions, degree), encoded[:, : direction_width(degree)])
    upstream = torch.randn(expected.shape, dtype=dtype, generator=torch.Generator().manual_seed(13))
    (gradient,) = torch.autograd.grad(encoded, normals, upstream)
    (expected_gradient,) = torch.autograd.grad(expected, plain_normals, upstream.double())
    # A gradient has the size 1 / |n| down to the length at which reflections fade out; below, its terms cancel.
    size = lengths / (lengths.square() + 1e-6)
    assert ((gradient - expected_gradient).abs() <= 100 * torch.finfo(dtype).eps * size).all()


def test_gradcheck_of_direction_encoding_passes_for_both_inputs() -> None:
    normals, directions = (2.0 * _units(6, 14)).requires_grad_(), _units(6, 15)
    assert torch.autograd.gradcheck(lambda n: direction_encoding(directions, 3, n), (normals,))
    assert torch.autograd.gradcheck(lambda d, n: direction_encoding(d, 3, n), (directions.requires_grad_(), normals))


def test_encoded_directions_have_the_same_bits_for_any_number_of_threads() -> None:
    directions, normals = _units(5000, 16).float(), _units(5000, 17).float()

    def run(threads: int) -> tuple[torch.Tensor, torch.Tensor]:
        leaf = normals.clone().requires_grad_()
        kernel.set_threads(threads)
        try:
            encoded = direction_encoding(directions, 3, leaf)
            encoded.square().sum().backward()
        finally:
            kernel.set_threads(None)
        assert leaf.grad is not None
        return encoded.detach(), leaf.grad

    assert all(torch.equal(*pair) for pair in zip(run(1), run(4), strict=True))
