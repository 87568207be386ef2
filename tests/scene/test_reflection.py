"""Highlights: the viewing direction mirrored at a learned normal, and the colour head that sees it."""

import torch

from graings.config import SceneConfig
from graings.scene.appearance import CanonicalAppearance
from graings.scene.encoding import mirrored


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
