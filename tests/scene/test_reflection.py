"""Highlights: the viewing direction mirrored at a learned normal, and the colour head that sees it."""

import pytest
import torch

from graings import kernel
from graings.config import SceneConfig
from graings.scene.appearance import CanonicalAppearance
from graings.scene.encoding import direction_encoding, direction_width, mirrored, plain_direction_encoding


def _units(rows: int, seed: int) -> torch.Tensor:
    vectors = torch.randn(rows, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return vectors / vectors.norm(dim=-1, keepdim=True)


def test_mirrored_is_the_law_of_reflection() -> None:
    directions, normals = _units(500, 1), _units(500, 2)
    out = mirrored(directions, 7.0 * normals)
    # Same length, opposite angle to the normal, same plane; the epsilon is 1e-6 of a squared length of 49.
    torch.testing.assert_close(out.norm(dim=-1), torch.ones(500, dtype=torch.float64), rtol=0, atol=1e-7)
    torch.testing.assert_close((out * normals).sum(-1), -(directions * normals).sum(-1), rtol=0, atol=1e-7)
    triple = torch.linalg.cross(directions, normals, dim=-1)
    torch.testing.assert_close((out * triple).sum(-1), torch.zeros(500, dtype=torch.float64), rtol=0, atol=1e-12)


def test_a_normal_of_no_length_mirrors_nothing_and_its_gradient_is_finite() -> None:
    directions = _units(4, 3).float()
    scales = torch.tensor([[0.0], [1e-30], [1e-3], [1e18]])
    vectors = (scales * _units(4, 4).float()).requires_grad_()
    out = mirrored(directions, vectors)
    assert torch.equal(out[:2], directions[:2])
    # Between, at a squared length of the epsilon, half of the reflection: no longer than what came in.
    assert (out.norm(dim=-1) <= 1 + 1e-6).all()
    (gradient,) = torch.autograd.grad(out.sum(), vectors)
    assert gradient.isfinite().all()


def test_mirrored_has_the_gradient_of_differences() -> None:
    vectors = (2.0 * _units(6, 5)).requires_grad_()
    directions = _units(6, 6).requires_grad_()
    assert torch.autograd.gradcheck(mirrored, (directions, vectors))


def test_colour_depends_on_the_normal_only_where_reflection_is_on() -> None:
    features = torch.randn(5, 8, generator=torch.Generator().manual_seed(7))
    directions, children = _units(5, 8).float(), torch.arange(5 * 3)
    with_it = CanonicalAppearance(SceneConfig(children=3, feature_dim=8, reflection=True), 0.1)
    without = CanonicalAppearance(SceneConfig(children=3, feature_dim=8, reflection=False), 0.1)
    assert without.normal is None
    assert with_it.normal is not None
    before = with_it.colors(features, directions, children)
    with torch.no_grad():
        with_it.normal.bias += 1.0
    assert not torch.equal(with_it.colors(features, directions, children), before)
    with_it.colors(features, directions, children).sum().backward()
    assert with_it.normal.weight.grad is not None
    assert with_it.normal.weight.grad.abs().sum() > 0


def test_surfaces_that_mirror_the_same_direction_look_alike_to_the_harmonics_of_it() -> None:
    """Two views mirrored at two normals into one direction are one input: what a highlight learned, all learn."""
    target = _units(1, 9)
    views = _units(20, 10)
    normals = target - views  # the mirror that turns each view into the target
    torch.testing.assert_close(mirrored(views, 10 * normals), target.expand(20, 3), rtol=0, atol=1e-5)


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_kernel_says_of_directions_and_mirrors_what_torch_says(degree: int, dtype: torch.dtype) -> None:
    lengths = torch.logspace(-6, 6, 3000, dtype=torch.float64).unsqueeze(-1)
    directions, normals = _units(3000, 11).to(dtype), (lengths * _units(3000, 12)).to(dtype).requires_grad_()
    encoded = direction_encoding(directions, degree, normals)
    plain_normals = normals.detach().double().requires_grad_()
    expected = plain_direction_encoding(directions.double(), degree, plain_normals)
    # Numbers up to 3, computed in float64 by both: each may be off by a unit in the last place of what it is kept in.
    torch.testing.assert_close(encoded.double(), expected, rtol=0, atol=4 * torch.finfo(dtype).eps)
    assert torch.equal(direction_encoding(directions, degree), encoded[:, : direction_width(degree)])
    upstream = torch.randn(expected.shape, dtype=dtype, generator=torch.Generator().manual_seed(13))
    (gradient,) = torch.autograd.grad(encoded, normals, upstream)
    (expected_gradient,) = torch.autograd.grad(expected, plain_normals, upstream.double())
    # A gradient is as large as 1 / |n| until a normal fades; its terms cancel where it is smaller.
    size = lengths / (lengths.square() + 1e-6)
    assert ((gradient - expected_gradient).abs() <= 100 * torch.finfo(dtype).eps * size).all()


def test_encoded_directions_have_the_gradient_of_differences_in_both() -> None:
    normals, directions = (2.0 * _units(6, 14)).requires_grad_(), _units(6, 15)
    assert torch.autograd.gradcheck(lambda n: direction_encoding(directions, 3, n), (normals,))
    assert torch.autograd.gradcheck(lambda d, n: direction_encoding(d, 3, n), (directions.requires_grad_(), normals))


def test_encoded_directions_are_the_same_for_any_number_of_threads() -> None:
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
