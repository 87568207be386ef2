"""A motion basis: its error against the exact scene is what it reports, at all times, for all kinds of scenes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from graings import constants, kernel
from graings.camera.camera import Camera, View
from graings.camera.sampling_rate import SamplingRate
from graings.evaluation.metrics import psnr
from graings.render import render
from graings.scene.child_blocks import BLOCK, ActiveUnits
from graings.scene.motion_basis import MotionBasis
from graings.scene.motion_signals import GeometrySignal, ResidualSignal
from graings.scene.prepared import PreparedScene
from graings.scene.scene import Scene
from graings.scene.time_basis import QUANTILE, TimeBasis, errors, fit, quantile
from tests.models import EYE, tiny_scene
from tests.scene.test_prepared import CONFIGS, scene_of

VIEWS = [
    View(f"train:{number}", Camera.orbit(37.0 * number, 20.0, 3.0, fov=0.9, width=200, height=150), number / 8)
    for number in range(9)
]
# Times that neither the basis was learned from nor its errors were measured at.
OTHER_TIMES = [(0.13 + 0.6180339887 * number) % 1.0 for number in range(40)]


def measured(prepared: PreparedScene, basis: MotionBasis, times: list[float]) -> Tensor:
    """Displacement in px [time, child] of the ends of the drawn ellipsoids' axes, in the view that shows it most."""
    reach = float(np.sqrt(2 * np.log(255)))
    rows, found = torch.arange(prepared.children), []
    for time in times:
        ends = []
        for means, quats, log_scales in (prepared.geometry(time, rows), basis.geometry_at(time)):
            axes = rotations(quats.double()) * log_scales.double().exp().unsqueeze(1) * reach
            ends.append(torch.stack([means.double() + sign * axes[:, :, k] for k in range(3) for sign in (-1, 1)]))
        largest = torch.zeros(len(rows), dtype=torch.float64)
        for view in VIEWS:
            here, there = (view.camera.project(part.flatten(0, 1).numpy())[0] for part in ends)
            moved = torch.from_numpy(np.linalg.norm(here - there, axis=1)).view(6, -1).amax(0)
            largest = torch.maximum(largest, moved)
        found.append(largest)
    return torch.stack(found)


def rotations(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3]."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


@pytest.mark.parametrize(("config", "pixels"), [*((config, 0.2) for config in CONFIGS), ({}, 0.02), ({}, 3.0)], ids=str)
def test_the_error_is_within_the_bound_and_as_reported(config: dict[str, Any], pixels: float) -> None:
    prepared = PreparedScene(scene_of(config))
    basis = MotionBasis.of(prepared, VIEWS, pixels=pixels)
    report = basis.report.geometry
    assert report.error.rms <= report.error.p99 <= pixels
    found = measured(prepared, basis, OTHER_TIMES)
    # The reported error is a bound to first order in the views' perspective, over other times.
    assert quantile(found) <= 1.1 * max(report.error.p99, pixels)
    assert float(found.max()) <= 1.5 * max(report.error.max, pixels)
    colors = basis.report.residual
    assert colors.error.p99 <= colors.bound


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_smaller_bound_takes_more_functions(seed: int) -> None:
    prepared = PreparedScene(tiny_scene(anchors=300, seed=seed))
    bases = [MotionBasis.of(prepared, VIEWS, pixels=pixels) for pixels in (2.0, 0.3, 0.05)]
    ranks = [basis.report.geometry.rank for basis in bases]
    assert 0 < ranks[0] < ranks[1] < ranks[2] <= 16  # the hidden units of the network
    sizes = [basis.report.geometry.error.rms for basis in bases]
    assert sizes[0] > sizes[1] > sizes[2]


def test_weights_fill_their_range() -> None:
    basis = MotionBasis.of(PreparedScene(tiny_scene(anchors=100)), VIEWS)
    for part in (basis.geometry, basis.residual):
        assert part.rank > 0
        torch.testing.assert_close(part.weights.abs().amax(0), torch.ones(part.rank))
        assert part.weights.dtype == part.functions.dtype == torch.float32
    assert basis.geometry.functions.shape[1:] == (basis.geometry.rank, 10)
    assert basis.residual.functions.shape[1:] == (basis.residual.rank, 4)


def scene_with_one_mover() -> Scene:
    """Anchors of which only those with x > 0.3 move: the first layers see nothing else."""
    scene = tiny_scene(anchors=200, position_frequencies=0, deform_depth=1, residual=False)
    assert scene.deformation is not None
    with torch.no_grad():
        first = scene.deformation.from_position
        first.weight.zero_()
        first.weight[:, 0] = 1.0
        first.bias.fill_(-0.3)
    return scene


def test_children_without_motion_have_no_weights() -> None:
    prepared = PreparedScene(scene_with_one_mover())
    basis = MotionBasis.of(prepared, VIEWS, pixels=0.1)
    assert 5 < len(basis.geometry.rows) < 0.5 * prepared.children
    at_rest = measured(prepared, replace(basis, geometry=TimeBasis.empty(10)), OTHER_TIMES).amax(0)
    assert float(at_rest.max()) > 1.0
    assert set((at_rest > 0.11).nonzero().squeeze(1).tolist()) <= set(basis.geometry.rows.tolist())
    assert basis.report.geometry.error.max < 1.0
    assert len(basis.residual.rows) == basis.residual.rank == 0


def test_a_constant_offset_is_part_of_the_state_not_of_the_motion() -> None:
    scene = tiny_scene(anchors=50, residual=False)
    assert scene.deformation is not None
    with torch.no_grad():
        scene.deformation.out.weight.zero_()
        scene.deformation.out.bias[:3] = 0.3
    prepared = PreparedScene(scene)
    basis = MotionBasis.of(prepared, VIEWS, pixels=0.1)
    assert basis.geometry.rank == 0
    found, expected = basis.geometry_at(0.4), prepared.geometry(0.4, torch.arange(prepared.children))
    for here, there in zip(found, expected, strict=True):
        torch.testing.assert_close(here, there, rtol=0, atol=1e-6)


@pytest.mark.parametrize("config", [{}, {"opacity_view": True}, {"residual": False}, {"deformation": "none"}], ids=str)
def test_a_scene_of_one_instant_has_no_functions(config: dict[str, Any]) -> None:
    prepared = PreparedScene(scene_of(config, temporal=False))
    basis = MotionBasis.of(prepared, VIEWS[:1])
    assert basis.geometry.rank == basis.residual.rank == 0
    assert basis.report.geometry.error.max < 1e-5  # rounding of a mean
    rows = torch.arange(prepared.children)
    for here, there in zip(basis.geometry_at(0.7), prepared.geometry(0.7, rows), strict=True):
        assert torch.equal(here, there)
    opacities = prepared.canonical_opacities(VIEWS[0].camera.center)
    assert torch.equal(basis.residual_at(0.7)[:, 3], opacities)


def test_nothing_shown_and_no_views() -> None:
    scene = scene_of({})
    assert MotionBasis.of(PreparedScene(scene), [], pixels=0.1).report.geometry.error.p99 <= 0.1
    with torch.no_grad():
        scene.scaffold.opacity_offsets.fill_(-5.0)
    basis = MotionBasis.of(PreparedScene(scene), VIEWS)
    assert basis.report.children == len(basis.geometry_at(0.3)[0]) == 0


def test_a_huge_scene_has_the_same_rank_as_a_small_one() -> None:
    small = tiny_scene(anchors=60, relative_scales=True)
    large = tiny_scene(anchors=60, relative_scales=True)
    size = 100.0
    with torch.no_grad():
        large.scaffold.anchors.mul_(size)
        large.scaffold.log_scales.add_(float(np.log(size)))
        large.extent.mul_(size)
    large.sampling = SamplingRate(size, 10.0 / size, 10.0 / size)
    far = [
        View(view.name, Camera.orbit(37.0 * number, 20.0, 3.0 * size, fov=0.9, width=200, height=150), view.time)
        for number, view in enumerate(VIEWS)
    ]
    one, other = (
        MotionBasis.of(PreparedScene(scene), views, pixels=0.1) for scene, views in ((small, VIEWS), (large, far))
    )
    assert abs(one.geometry.rank - other.geometry.rank) <= 1
    assert other.report.geometry.error.p99 <= 0.1


def test_times_of_the_views_may_be_anywhere() -> None:
    prepared = PreparedScene(tiny_scene(anchors=60))
    crowded = [View(view.name, view.camera, 0.001 * number**2) for number, view in enumerate(VIEWS)]
    basis = MotionBasis.of(prepared, crowded, pixels=0.1)
    assert quantile(measured(prepared, basis, OTHER_TIMES)) <= 0.15


def test_turning_all_the_way_around() -> None:
    """Quaternions whose mean over time is nearly zero."""

    prepared = PreparedScene(tiny_scene(anchors=5, residual=False))
    exact = prepared.geometry

    def turning(time: float, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        means, quats, log_scales = exact(0.0, rows)
        angle = torch.tensor(np.pi * 2 * time, dtype=torch.float32)  # half of a full double turn
        return means, torch.stack([angle.cos(), angle.sin(), angle * 0, angle * 0]).expand_as(quats), log_scales

    prepared.geometry = turning  # type: ignore[method-assign]
    basis = MotionBasis.of(prepared, VIEWS, pixels=0.1)
    assert 0 < basis.geometry.rank <= 3
    assert quantile(measured(prepared, basis, OTHER_TIMES)) <= 0.1


def test_a_motion_that_is_not_finite_is_refused() -> None:
    scene = tiny_scene(anchors=20)
    assert scene.deformation is not None
    with torch.no_grad():
        scene.deformation.out.bias[0] = torch.nan
    with pytest.raises(ValueError, match="not finite"):
        MotionBasis.of(PreparedScene(scene), VIEWS)


@pytest.mark.parametrize("bound", [0.0, -1.0, float("nan")])
def test_a_bound_is_above_zero(bound: float) -> None:
    prepared = PreparedScene(tiny_scene())
    with pytest.raises(ValueError, match="above 0"):
        MotionBasis.of(prepared, VIEWS, pixels=bound)
    with pytest.raises(ValueError, match="above 0"):
        MotionBasis.of(prepared, VIEWS, levels=bound)


def test_the_residual_that_depends_on_the_view_is_its_mean_over_eyes() -> None:
    prepared = PreparedScene(tiny_scene(anchors=60, residual_sh_degree=2))
    times = [number / 8 for number in range(9)]
    signal = ResidualSignal(prepared, VIEWS, times, 1e-4)
    assert len(signal.eyes) > 1
    rows = torch.arange(prepared.children)
    mean = torch.stack([prepared.residual(0.3, [eye], rows) for eye in signal.eyes]).mean(0)
    torch.testing.assert_close(signal.at(0.3, rows) + signal.state, mean, rtol=0, atol=1e-6)


def test_fitting_no_children_gives_no_functions() -> None:
    prepared = PreparedScene(tiny_scene(anchors=5))
    signal = GeometrySignal(prepared, VIEWS, [0.0, 1.0], 1.0)
    basis, found = fit(signal, torch.empty(0, dtype=torch.int64), [0.0, 1.0], [0.5], 1.0)
    assert basis.rank == found.numel() == errors(signal, basis, [0.5]).numel() == 0
    assert TimeBasis.empty(10).offsets(0.3).shape == (0, 10)
    assert quantile(torch.arange(1000.0)) == pytest.approx(1000 * QUANTILE, abs=1)


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_the_fast_scene_shows_what_the_basis_says(config: dict[str, Any]) -> None:
    exact = PreparedScene(scene_of(config))
    basis = MotionBasis.of(exact, VIEWS, pixels=3.0, levels=25.0)
    fast, eye = basis.prepared(exact, view_levels=255.0), VIEWS[4].camera.center
    for time in (0.0, 0.31, 1.0):
        residual = basis.residual_at(time)
        shown = residual[:, 3] > constants.ALPHA_MIN
        composed = fast.compose(eye, time)
        if config.get("opacity_view") is None:  # otherwise the state has the opacities of another view
            assert torch.equal(composed.children, basis.slots[shown])
        rows = torch.searchsorted(basis.slots, composed.children)
        gaussians = composed.gaussians
        everything = torch.arange(exact.children)
        cheaper = fast.products < exact.products  # otherwise the exact geometry stays
        geometry = basis.geometry_at(time) if cheaper else exact.geometry(time, everything)
        for found, expected in zip((gaussians.means, gaussians.quats, gaussians.log_scales), geometry, strict=True):
            torch.testing.assert_close(found, expected[rows], rtol=1e-5, atol=1e-5)
        offset = residual[rows, 3] - basis.opacities[rows] + basis.opacity_offsets[rows]
        opacities = exact.canonical_opacities(eye)[rows] + offset
        torch.testing.assert_close(gaussians.opacities, opacities, rtol=0, atol=1e-5)
        colors = (exact.canonical_colors(eye)[rows] + residual[rows, :3]).clamp(0, 1)
        torch.testing.assert_close(gaussians.colors, colors, rtol=0, atol=1e-5)
        assert torch.equal(gaussians.uids, basis.uids[rows])


def test_the_fast_scene_in_float64() -> None:
    exact = PreparedScene(scene_of({}).double())
    fast = MotionBasis.of(exact, VIEWS, pixels=2.0).prepared(exact)
    assert fast.products < exact.products
    found, expected = fast.compose(EYE, 0.31), exact.compose(EYE, 0.31)
    here = found.gaussians.means[torch.isin(found.children, expected.children)]
    there = expected.gaussians.means[torch.isin(expected.children, found.children)]
    assert here.dtype == torch.float64
    assert float((here - there).norm(dim=1).max()) < 0.1


def test_colours_of_the_residual_stay_exact_where_the_view_counts_more_than_the_bound() -> None:
    exact = PreparedScene(scene_of({"residual_sh_degree": 2}))
    basis = MotionBasis.of(exact, VIEWS, levels=0.1)
    assert basis.report.residual_of_views.p99 > 0.1
    found, expected = basis.prepared(exact, view_levels=0.1).compose(EYE, 0.31), exact.compose(EYE, 0.31)
    both = torch.isin(found.children, expected.children)
    assert torch.equal(
        found.gaussians.colors[both],
        expected.gaussians.colors[torch.isin(expected.children, found.children)],
    )


def test_the_fast_image_is_as_near_as_its_bound_says() -> None:
    """To first order a shift by d px changes a pixel by at most 6.13 d of its contrast."""
    exact = PreparedScene(scene_of({}))
    psnrs = []
    for pixels in (10.0, 1.0, 0.01):
        fast = MotionBasis.of(exact, VIEWS, pixels=pixels, levels=10 * pixels).prepared(exact)
        images = [render(scene, VIEWS[3].camera, 0.41, (1.0, 1.0, 1.0)).color for scene in (fast, exact)]
        psnrs.append(psnr(*images))
        assert float((images[0] - images[1]).square().mean().sqrt()) < 6.13 * pixels
    assert psnrs[0] < psnrs[1] < psnrs[2]
    assert psnrs[2] > 55


def test_the_fast_scene_never_costs_more() -> None:
    exact = PreparedScene(scene_of({}))
    rough, fine = (MotionBasis.of(exact, VIEWS, pixels=pixels).prepared(exact) for pixels in (3.0, 0.001))
    assert rough.products < exact.products == fine.products
    rows = torch.arange(exact.children)
    assert torch.equal(fine.geometry(0.3, rows)[0], exact.geometry(0.3, rows)[0])
    assert not torch.equal(rough.geometry(0.3, rows)[0], exact.geometry(0.3, rows)[0])


def test_the_fast_scene_keeps_its_own_times() -> None:
    exact = PreparedScene(scene_of({}))
    fast = MotionBasis.of(exact, VIEWS, pixels=2.0).prepared(exact)
    here, there = exact.compose(EYE, 0.5).gaussians.means, fast.compose(EYE, 0.5).gaussians.means
    assert here.shape != there.shape or not torch.equal(here, there)
    assert torch.equal(exact.compose(EYE, 0.5).gaussians.means, here)
    assert fast.bytes > 0


@pytest.mark.parametrize("wrong", ["units", "begin", "out"])
def test_the_blend_kernel_refuses_arrays_that_do_not_fit(wrong: str) -> None:
    weights, functions, out = ActiveUnits.of(torch.ones(2 * BLOCK, 3)), torch.ones(3, 4), torch.empty(2 * BLOCK, 4)
    begin, units = weights.begin, weights.units
    if wrong == "units":
        units = units + 1
    elif wrong == "begin":
        begin = begin + 1
    else:
        out = torch.empty(2 * BLOCK, 3)
    with pytest.raises(ValueError, match=wrong):
        kernel.kernel().blend(weights.values, begin, units, torch.zeros(2, 4, BLOCK), functions, out, 1)
