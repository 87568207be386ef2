"""The model: Eq. 3-5, 7 and 9-13 of the paper."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.nn import functional

from graings import constants, kernel
from graings.scene.canonical import INITIAL_SCALE
from graings.scene.clip import clip
from graings.scene.encoding import (
    direction_encoding,
    direction_width,
    encoding_width,
    frequency_encoding,
    plain_frequency_encoding,
)
from tests.models import EYE, tiny_scene


def test_untrained_deformation_and_residual_are_identity() -> None:
    dynamic = tiny_scene(trained=False, temporal=True).compose(EYE, 0.7).gaussians
    static = tiny_scene(trained=False, temporal=False).compose(EYE, 0.7).gaussians
    assert torch.equal(dynamic.means, static.means)
    assert torch.equal(dynamic.log_scales, static.log_scales)
    assert torch.equal(dynamic.colors, static.colors)
    assert torch.equal(dynamic.opacities, static.opacities)
    assert torch.allclose(dynamic.quats, static.quats, atol=1e-7)


def test_gradient_of_canonical_mean_has_the_bits_of_that_of_the_deformed_mean() -> None:
    # Eq. 9: with the stop-gradient dL/dx_can = dL/dx(t).
    composition = tiny_scene().compose(EYE, 0.4)
    composition.canonical_means.retain_grad()
    composition.gaussians.means.retain_grad()
    means = composition.gaussians.means
    (means.sin() * torch.linspace(0.1, 2.0, means.numel()).view_as(means)).sum().backward()
    assert composition.canonical_means.grad is not None
    assert torch.equal(composition.canonical_means.grad, means.grad)


def test_without_stop_gradient_the_deformation_reaches_the_canonical_mean() -> None:
    composition = tiny_scene(stop_gradient=False).compose(EYE, 0.4)
    composition.canonical_means.retain_grad()
    composition.gaussians.means.retain_grad()
    composition.gaussians.means.sin().sum().backward()
    assert not torch.allclose(composition.canonical_means.grad, composition.gaussians.means.grad, atol=1e-4)


def test_deformation_sends_no_gradient_to_the_scaffold() -> None:
    scene = tiny_scene()
    composition = scene.compose(EYE, 0.4)
    deformation = composition.deformation
    assert deformation is not None
    deformation.offsets(0).sum().backward()
    assert all(parameter.grad is None for parameter in scene.scaffold.parameters())
    assert scene.deformation is not None
    assert scene.deformation.out.weight.grad is not None


def test_static_scene_evaluates_no_temporal_module() -> None:
    scene = tiny_scene(temporal=False)
    composition = scene.compose(EYE, 0.4)
    assert composition.deformation is None
    assert composition.residual is None
    composition.gaussians.means.sum().backward()
    assert scene.deformation is not None
    assert all(parameter.grad is None for parameter in scene.deformation.parameters())


def test_only_children_above_one_grey_level_are_rendered() -> None:
    scene = tiny_scene()
    with torch.no_grad():
        scene.scaffold.opacity_offsets.normal_(std=0.5)
    composition = scene.compose(EYE, 0.4)
    rendered = composition.opacities.flatten() > constants.ALPHA_MIN
    assert 0 < int(rendered.sum()) < rendered.numel()
    assert torch.equal(composition.children, rendered.nonzero().squeeze(-1))
    assert torch.equal(composition.gaussians.opacities, composition.opacities.flatten()[rendered])


def test_residual_is_bounded_by_eta() -> None:
    scene = tiny_scene(residual_scale=0.1)
    with torch.no_grad():
        scene.residual.out.weight.mul_(1e3)
        scene.residual.seeing.out.weight.mul_(1e3)
    composition = scene.compose(EYE, 0.4)
    assert float(composition.residual.detach().abs().max()) <= 0.1 + 1e-7
    assert float(composition.gaussians.colors.detach().amin()) >= 0.0
    assert float(composition.gaussians.colors.detach().amax()) <= 1.0


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_residual_of_colour_depends_on_the_view_as_configured_and_that_of_opacity_never(degree: int) -> None:
    scene = tiny_scene(residual_sh_degree=degree)
    here, there = (scene.compose(eye, 0.4) for eye in (EYE, [-x for x in EYE]))
    assert torch.equal(here.children, there.children)
    assert here.residual is not None
    assert there.residual is not None
    differs = (here.residual - there.residual).detach().abs().amax(0)
    assert float(differs[3]) == 0.0
    assert float(differs[:3].amax()) > 1e-3 if degree > 0 else float(differs[:3].amax()) == 0.0


def test_children_move_independently_unless_deformation_is_per_anchor() -> None:
    for mode, spread in (("child", True), ("anchor", False)):
        composition = tiny_scene(deformation=mode).compose(EYE, 0.4)
        offsets = composition.position_offsets.detach()
        owners = composition.children // 3
        varies = any(
            not torch.allclose(offsets[owners == anchor], offsets[owners == anchor][:1], atol=1e-7)
            for anchor in owners.unique()
        )
        assert varies is spread


GEOMETRY, APPEARANCE = ("means", "quats", "log_scales"), ("opacities", "colors")


@pytest.mark.parametrize(
    ("ablation", "networks", "constant"),
    [
        ({}, {"static", "deformation", "residual"}, ()),
        ({"single_mlp": True}, {"single", "residual"}, ()),
        ({"canonical": False}, {"deformation", "residual"}, ()),
        ({"residual": False}, {"static", "deformation"}, APPEARANCE),
        ({"deformation": "none"}, {"static", "residual"}, GEOMETRY),
    ],
    ids=("full", "single_mlp", "no_canonical", "no_residual", "no_deformation"),
)
def test_a_structural_ablation_removes_its_networks_and_all_others_are_trained(
    ablation: dict[str, object], networks: set[str], constant: tuple[str, ...]
) -> None:
    scene = tiny_scene(**ablation)
    assert {name for name, _ in scene.named_children()} == {"scaffold", "appearance"} | networks
    early, late = (composition.gaussians for composition in scene.compose_together([(EYE, 0.1), (EYE, 0.8)]))
    for name in GEOMETRY + APPEARANCE:
        assert torch.equal(getattr(early, name), getattr(late, name)) is (name in constant), name
    random = torch.Generator().manual_seed(0)
    loss = torch.zeros(())
    for values in (getattr(late, name) for name in GEOMETRY + APPEARANCE):
        loss = loss + (values * torch.randn(values.shape, generator=random)).sum()
    loss.backward()
    for name, parameter in scene.named_parameters():
        assert parameter.grad is not None, name
        assert 0 < float(parameter.grad.norm()) < math.inf, name


def test_without_the_canonical_branch_children_have_no_rotation_and_the_initial_scale() -> None:
    scene = tiny_scene(canonical=False, temporal=False)
    composition = scene.compose(EYE, 0.4)
    gaussians, owners = composition.gaussians, composition.children // scene.scaffold.slots
    assert torch.equal(gaussians.quats, torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(len(owners), 4))
    expected = scene.scaffold.log_scales[owners] + math.log(INITIAL_SCALE)
    torch.testing.assert_close(gaussians.log_scales, expected, rtol=0, atol=1e-6)


def test_opacity_depends_on_the_view_only_with_opacity_view() -> None:
    for view, same in ((False, True), (True, False)):
        scene = tiny_scene(opacity_view=view)
        here = scene.compose(EYE, 0.4).opacities
        there = scene.compose((2.0, 0.0, 0.5), 0.4).opacities
        assert torch.equal(here, there) is same


def test_camera_on_an_anchor_gives_finite_colours() -> None:
    scene = tiny_scene()
    gaussians = scene.compose(scene.scaffold.anchors[0].tolist(), 0.4).gaussians
    assert bool(torch.isfinite(gaussians.colors).all())


def test_deform_gives_the_deformation_of_the_composition() -> None:
    scene = tiny_scene()
    composition = scene.compose(EYE, 0.4)
    again = scene.deform(composition.children, composition.canonical_means, 0.4)
    assert torch.equal(again.outputs, composition.deformation.outputs)
    assert torch.equal(again.position_offsets(0), composition.position_offsets)


def test_views_that_render_nothing_compose_no_gaussians() -> None:
    scene = tiny_scene()
    with torch.no_grad():
        scene.appearance.opacity[-1].bias.fill_(-20.0)
    for composition in scene.compose_together([(EYE, 0.1), (EYE, 0.6)]):
        assert len(composition.gaussians) == 0
        assert composition.deformation.outputs.shape == (0, 2, 10)


@pytest.mark.parametrize(
    "options", [{}, {"deformation": "anchor"}, {"time_conditioning": "concatenated"}, {"single_mlp": True}]
)
def test_views_composed_together_have_their_own_times(options: dict[str, object]) -> None:
    scene = tiny_scene(**options)
    times = (0.1, 0.4, 0.9)
    together = scene.compose_together([(EYE, time) for time in times])
    for index, (time, composition) in enumerate(zip(times, together, strict=True)):
        alone = scene.deform(composition.children, composition.canonical_means, time)
        torch.testing.assert_close(composition.deformation.offsets(index), alone.offsets(0))
        torch.testing.assert_close(composition.position_offsets, alone.position_offsets(0))
        moved = composition.canonical_means + composition.position_offsets
        torch.testing.assert_close(composition.gaussians.means, moved)


def test_projected_clip_blocks_only_gradients_that_point_outwards() -> None:
    x = torch.tensor([-1.0, -1.0, 0.5, 2.0, 2.0], requires_grad=True)
    clip(x, 0.0, 1.0, projected=True).backward(torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0]))
    assert torch.equal(x.grad, torch.tensor([0.0, -1.0, 1.0, 1.0, 0.0]))
    x.grad = None
    clip(x, 0.0, 1.0, projected=False).backward(torch.ones(5))
    assert torch.equal(x.grad, torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0]))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-11), (torch.float32, 2.0**-24)])
def test_encoding_by_the_kernel_equals_its_oracle_up_to_the_highest_octave(
    dtype: torch.dtype, tolerance: float
) -> None:
    x = (torch.rand(2_500, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 4 - 2).to(dtype)
    expected = plain_frequency_encoding(x.double(), 12)
    assert (frequency_encoding(x, 12).double() - expected).abs().max() <= tolerance
    kernel.set_threads(1)
    single_threaded = frequency_encoding(x, 12)
    kernel.set_threads(None)
    assert torch.equal(single_threaded, frequency_encoding(x, 12))


def test_encoding_is_differentiable_where_positions_are_not_constants() -> None:
    x = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: frequency_encoding(x, 3), (x,))
    with torch.no_grad():
        assert torch.allclose(frequency_encoding(x, 3), plain_frequency_encoding(x, 3))


@pytest.mark.parametrize("view", [True, False])
def test_no_direction_gives_more_than_the_bound_of_opacity(view: bool) -> None:
    appearance, features = (scene := tiny_scene(opacity_view=view)).appearance, scene.scaffold.features
    highest = appearance.highest_opacity_logits(features)
    directions = functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    logits = torch.stack([appearance.opacity_logits(features, d.expand(len(features), 3)) for d in directions])
    assert (logits <= highest + 1e-6).all()
    if view:  # the bound is tight enough to be useful
        assert (highest - logits.amax(0)).max() < 0.5
    else:
        assert torch.allclose(logits.amax(0), highest, atol=1e-6)


def test_direction_encoding_begins_with_the_direction_and_is_orthogonal() -> None:
    # This quadrature is exact for products of two harmonics: Gauss nodes along the axis, equal angles around it.
    heights, weights = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(4))
    angles = torch.arange(8, dtype=torch.float64) * math.pi / 4
    radii = (1 - heights * heights).sqrt().unsqueeze(1)
    sphere = torch.stack([radii * angles.cos(), radii * angles.sin(), heights.unsqueeze(1).expand(4, 8)], dim=-1)
    for degree in (1, 2, 3):
        encoded = direction_encoding(sphere, degree)
        assert encoded.shape[-1] == direction_width(degree)
        assert torch.equal(encoded[..., :3], sphere)
        weighted = encoded * (weights / 16).view(4, 1, 1)
        products = weighted.flatten(0, 1).T @ encoded.flatten(0, 1)
        assert torch.allclose(products, torch.eye(direction_width(degree), dtype=torch.float64) / 3, atol=1e-15)


@pytest.mark.parametrize("x", [math.nan, math.inf])
def test_encoding_of_a_non_finite_number_is_nan(x: float) -> None:
    assert frequency_encoding(torch.full((1, 3), x), 2)[:, 3:].isnan().all()


def test_initial_weights_do_not_depend_on_which_other_networks_exist() -> None:
    full, without = tiny_scene(trained=False), tiny_scene(trained=False, residual=False, canonical=False)
    assert len(without.state_dict()) < len(full.state_dict())
    for name, values in without.state_dict().items():
        assert torch.equal(values, full.state_dict()[name]), name


def test_encoding_has_the_stated_width_and_values() -> None:
    encoded = frequency_encoding(torch.tensor([0.25, 0.5]), 2)
    assert encoded.shape == (encoding_width(2, 2),)
    phases = [0.25, 0.5, 0.5, 1.0]
    expected = [0.25, 0.5, *map(math.sin, phases), *map(math.cos, phases)]
    assert torch.allclose(encoded, torch.tensor(expected), atol=1e-7)
