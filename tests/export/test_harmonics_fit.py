"""Spherical harmonics fitted to the colours of a scene."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from graings.export.harmonics_fit import fit_splats
from graings.render import PreparedScene, render
from graings.scene.splats import Splats, harmonic_basis
from tests.capture.captures import orbit
from tests.export.models import SIZE, ring
from tests.models import SAMPLING, tiny_scene

WHITE = (1.0, 1.0, 1.0)


def psnr(a: Tensor, b: Tensor) -> float:
    return -10 * math.log10(float((a.clamp(0, 1) - b.clamp(0, 1)).square().mean()))


def random_splats(count: int, degree: int, seed: int = 0) -> Splats:
    torch.manual_seed(seed)
    harmonics = torch.randn(count, (degree + 1) ** 2, 3) * 0.05
    harmonics[:, 0] += torch.rand(count, 3) - 0.5
    return Splats(
        means=torch.randn(count, 3) * 0.2,
        quats=torch.randn(count, 4),
        log_scales=torch.full((count, 3), -2.5) + 0.3 * torch.randn(count, 3),
        opacities=torch.rand(count) * 0.8 + 0.1,
        harmonics=harmonics,
        blur=0.3,
        sampling=SAMPLING,
    )


def test_the_basis_is_that_of_3dgs() -> None:
    """Its polynomials with the constants printed in the literature, at any unit vector."""
    v = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1)
    x, y, z = v.unbind(-1)
    expected = [torch.full_like(x, 0.28209479177387814), -0.4886025119029199 * y, 0.4886025119029199 * z]
    expected += [-0.4886025119029199 * x, 1.0925484305920792 * x * y, -1.0925484305920792 * y * z]
    expected += [0.31539156525252005 * (2 * z**2 - x**2 - y**2), -1.0925484305920792 * x * z]
    expected += [0.5462742152960396 * (x**2 - y**2), -0.5900435899266435 * y * (3 * x**2 - y**2)]
    expected += [2.890611442640554 * x * y * z, -0.4570457994644658 * y * (4 * z**2 - x**2 - y**2)]
    expected += [0.3731763325901154 * z * (2 * z**2 - 3 * x**2 - 3 * y**2)]
    expected += [-0.4570457994644658 * x * (4 * z**2 - x**2 - y**2), 1.445305721320277 * z * (x**2 - y**2)]
    expected += [-0.5900435899266435 * x * (x**2 - 3 * y**2)]
    for degree in range(4):
        count = (degree + 1) ** 2
        assert torch.allclose(harmonic_basis(v, degree), torch.stack(expected[:count], -1), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splats_are_fitted_by_themselves(degree: int) -> None:
    splats = random_splats(30, degree)
    fit = fit_splats(splats, ring(60), 0.0)
    assert fit.splats.degree == degree
    assert len(fit.errors) == 4
    for name in ("means", "quats", "log_scales", "opacities"):
        assert torch.allclose(getattr(fit.splats, name), getattr(splats, name), rtol=1e-5)
    for camera in ring(7):
        drawn = [render(one, camera, 0.0, WHITE).color for one in (splats, fit.splats)]
        assert psnr(*drawn) > 55


@pytest.mark.parametrize("config", [{}, {"opacity_view": True}, {"residual_sh_degree": 0, "reflection": False}])
def test_a_fit_looks_like_the_scene_from_views_that_were_not_fitted(config: dict[str, object]) -> None:
    scene = PreparedScene(tiny_scene(**config))
    held_out = [orbit(index, 5, SIZE) for index in range(5)]
    quality = []
    for degree in (0, 3):
        splats = fit_splats(scene, ring(60), 0.4, degree=degree).splats
        found = [psnr(render(scene, c, 0.4, WHITE).color, render(splats, c, 0.4, WHITE).color) for c in held_out]
        quality.append(sum(found) / len(found))
    assert quality[1] > quality[0] + (1 if config.get("opacity_view") else 6)
    assert quality[1] > (30 if config.get("opacity_view") else 45)


def test_a_fit_tells_what_no_view_shows() -> None:
    splats = random_splats(30, 1)
    splats.means[:10, 2] += 100.0
    contributions = fit_splats(splats, ring(2), 0.0).contributions
    assert bool((contributions[:10] == 0).all())
    assert bool((contributions[10:] > 0).all())


def test_a_wrong_degree_and_no_cameras_are_refused() -> None:
    with pytest.raises(ValueError, match="degree"):
        fit_splats(random_splats(3, 1), ring(2), 0.0, degree=4)
    with pytest.raises(ValueError, match="at least one camera"):
        fit_splats(random_splats(3, 1), [], 0.0)
