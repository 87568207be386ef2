"""What the preset `paper` does: the equations as printed, and no intervention that the paper does not print."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from graings import constants
from graings.config import GuardConfig, TrainConfig, make_config
from graings.errors import DivergedError
from graings.gaussians import Gaussians
from graings.raster.photometric_reference import photometric
from graings.raster.rasterize import rasterize
from graings.render import draw
from graings.scene.scene import Scene
from graings.training.density.control import DensityControl
from graings.training.density.growth import MIN_GROWTH, grow
from graings.training.density.statistics import DensityStatistics
from graings.training.guard.guard import MIN_NORMS, Gradient, Guard
from graings.training.optimizer import Optimizer
from graings.training.run import TrainingRun
from graings.training.trainer import Trainer
from tests import scenes
from tests.models import EYE, tiny_scene
from tests.training.micro import events_of, micro_trainer, spoil_gradient, spoil_loss, steps

VOXEL = 0.01
OTHER_EYE = (1.5, 1.0, -1.0)


def paper_scene(**changes: object) -> Scene:
    """A tiny scene of the structure that `paper` has."""
    small = {"children": 3, "feature_dim": 8, "head_width": 8, "static_width": 8, "deform_width": 16, "deform_depth": 2}
    return tiny_scene(**{**make_config("paper").scene.model_dump(), **small, **changes})  # type: ignore[arg-type]


def paper_trainer(capture: Path, **changes: object) -> Trainer:
    """A trainer of `paper` on a tiny capture: as `micro_trainer`, whose preset is another one."""
    return micro_trainer(capture, **(tiny_paper() | changes))


def tiny_paper() -> dict[str, object]:
    """The options of `paper` by name, small enough for a test; growth and pruning are those of the preset."""
    named = make_config("paper").model_dump()
    parts = {
        f"{part}.{name}": value
        for part in ("scene", "loss", "density", "rates", "guard", "init")
        for name, value in named[part].items()
    }
    whole = {name: value for name, value in named.items() if not isinstance(value, dict)}
    small = {"scene.children": 3, "scene.feature_dim": 8, "scene.deform_width": 16, "scene.deform_depth": 2}
    still: dict[str, object] = {"iterations": 200, "threads": 1, "init.points": 300, "density.min_observations": 2}
    return whole | parts | small | still


def positions_only(scene: Scene) -> Tensor:
    """The gradient of the sum of all deformed positions with respect to x_a."""
    scene.compose(EYE, 0.3).gaussians.means.sum().backward()
    gradient = scene.scaffold.anchors.grad
    assert gradient is not None
    return gradient


# Eq. 3 to 5, the scaffold


def test_anchor_positions_are_learned_and_follow_the_image() -> None:
    scene, camera = paper_scene(), scenes.pinhole()
    assert {"scaffold.anchors", "scaffold.log_scales", "scaffold.features"} <= dict(scene.named_parameters()).keys()
    drawn = scene.compose((0.0, 0.0, -2.0), 0.3)
    moved = replace(drawn, gaussians=replace(drawn.gaussians, means=drawn.gaussians.means + torch.tensor([0, 0, 2.0])))
    draw(moved, camera, (1.0, 1.0, 1.0)).color.square().sum().backward()
    assert int((scene.scaffold.anchors.grad.abs().sum(1) > 0).sum()) > 5  # type: ignore[union-attr]


def test_with_the_stop_gradient_an_anchor_moves_its_children_as_a_whole_eq_9() -> None:
    """dx(t)/dx_a is the identity for each child: the term through DeformNet is missing."""
    scene = paper_scene()
    owners = scene.compose(EYE, 0.3).children // scene.scaffold.slots
    drawn = torch.bincount(owners, minlength=scene.scaffold.count).float()
    assert torch.equal(positions_only(scene), drawn.unsqueeze(1).expand(-1, 3))


@pytest.mark.parametrize("deformation", ["child", "anchor"])
def test_without_the_stop_gradient_it_does_not_eq_8(deformation: str) -> None:
    free = positions_only(paper_scene(deformation=deformation, stop_gradient=False))
    stopped = positions_only(paper_scene(deformation=deformation))
    assert float((free - stopped).abs().max()) > 1e-3


def test_the_gradient_of_anchors_has_the_same_bits_for_any_number_of_threads() -> None:
    found = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        scene = paper_scene(anchors=3_000)
        weights = torch.randn(len(scene.compose(EYE, 0.3).children), 3, generator=torch.Generator().manual_seed(0))
        (scene.compose(EYE, 0.3).gaussians.means * weights).sum().backward()
        found.append(scene.scaffold.anchors.grad)
    torch.set_num_threads(1)
    assert torch.equal(*found)


@pytest.mark.parametrize(("relative", "change"), [(True, 1.0), (False, 0.0)])
def test_scales_are_those_of_static_mlp_alone_eq_5(relative: bool, change: float) -> None:
    """s_a sets how far children are from their anchor, and not how large they are."""
    scene = paper_scene(relative_scales=relative, temporal=False)
    with torch.no_grad():
        before = scene.compose(EYE, 0.0)
        scene.scaffold.log_scales += 1
        after = scene.compose(EYE, 0.0)
    assert not torch.allclose(before.canonical_means, after.canonical_means)
    difference = after.gaussians.log_scales - before.gaussians.log_scales
    torch.testing.assert_close(difference, torch.full_like(difference, change))


def test_scales_of_all_children_start_at_half_the_median_spacing(micro: Path) -> None:
    scene = paper_trainer(micro).scene
    with torch.no_grad():
        found = float(scene.compose(EYE, 0.0).gaussians.log_scales.median())
        assert found == pytest.approx(float(scene.scaffold.log_scales.median()) + math.log(0.5), abs=0.2)


# Eq. 10 to 13, what is clipped and who sees what


def test_log_scales_change_by_two_at_most_and_colours_stay_in_0_1() -> None:
    scene = paper_scene()
    with torch.no_grad():
        scene.deformation.out.bias[7:] = 50.0  # type: ignore[union-attr]
        scene.residual.out.bias[:] = 50.0  # type: ignore[union-attr]
        moving = scene.compose(EYE, 0.5)
        scene.temporal = False
        still = scene.compose(EYE, 0.5)
    slots = torch.isin(moving.children, still.children)
    torch.testing.assert_close(moving.gaussians.log_scales[slots], still.gaussians.log_scales + 2.0)
    expected = (still.gaussians.colors + 0.1).clamp(0, 1)
    torch.testing.assert_close(moving.gaussians.colors[slots], expected)
    torch.testing.assert_close(moving.gaussians.opacities[slots], still.gaussians.opacities + 0.1)


def test_colour_and_opacity_depend_on_the_view_and_the_residual_does_not() -> None:
    scene = paper_scene()
    one, other = scene.compose_together([(EYE, 0.4), (OTHER_EYE, 0.4)])
    assert not torch.allclose(one.gaussians.opacities, other.gaussians.opacities)
    assert not torch.allclose(one.gaussians.colors, other.gaussians.colors)
    assert one.residual is not None
    assert other.residual is not None
    assert torch.equal(one.residual, other.residual)


def test_the_residual_trains_the_feature_of_its_anchor_eq_12() -> None:
    scene = paper_scene()
    residual = scene.compose(EYE, 0.4).residual
    assert residual is not None
    residual.square().sum().backward()
    assert scene.scaffold.features.grad is not None
    assert bool(scene.scaffold.features.grad.any())


@pytest.mark.parametrize("opacity", [1e-6, 1e-3, constants.ALPHA_MIN])
def test_gaussians_between_0_and_one_grey_level_change_neither_image_nor_gradients(opacity: float) -> None:
    """The paper draws where o > 0. Like 3DGS, the rasterizer leaves out an alpha below 1/255 at a pixel."""
    some, faint, camera = scenes.gaussians(40, 0), scenes.gaussians(40, 1), scenes.pinhole()
    background = torch.ones(3, dtype=torch.float64)

    def drawn(level: float) -> tuple[Tensor, Tensor, Tensor]:
        more = replace(faint, opacities=torch.full((40,), level, dtype=torch.float64), uids=faint.uids + 1_000)
        both = Gaussians(*(torch.cat([getattr(some, name), getattr(more, name)]) for name in FIELDS))
        opacities = both.opacities.clone().requires_grad_()
        color = rasterize(replace(both, opacities=opacities), camera, background).color
        color.square().sum().backward()
        assert opacities.grad is not None
        return color.detach(), opacities.grad[:40], opacities.grad[40:]

    nothing, visible = drawn(0.0), drawn(3 * constants.ALPHA_MIN)
    found = drawn(opacity)
    assert torch.equal(found[0], nothing[0])
    assert torch.equal(found[1], nothing[1])
    assert not found[2].any()
    assert not torch.equal(visible[0], nothing[0])


FIELDS = ("means", "quats", "log_scales", "opacities", "colors", "uids")


# Eq. 14 to 18, the loss


def _square(rows: Tensor) -> Tensor:
    return rows.square().sum(-1).mean()


def test_the_loss_of_a_step_is_the_sum_of_the_four_printed_terms(micro: Path) -> None:
    trainer = paper_trainer(micro)
    scene, times = trainer.scene, trainer.capture.times
    scene.temporal = True
    assert scene.deformation is not None
    assert scene.residual is not None
    with torch.no_grad():
        scene.deformation.out.weight.normal_(std=0.1)
        scene.residual.out.weight.normal_(std=0.1)
    frame = min(trainer.capture.train, key=lambda one: one.time)  # the first time has one neighbour only
    composition = scene.compose(frame.camera.center, frame.time)
    image = draw(composition, frame.camera, trainer.background)
    for iteration in (100, 200):  # before and after the last growth
        found = trainer.objective(scene, [frame], [composition], [image], iteration)
        here, there = (scene.deform(composition.children, composition.canonical_means, t) for t in times[:2].tolist())
        assert here is not None
        assert there is not None
        assert composition.residual is not None
        expected = (
            photometric(image.color, torch.from_numpy(trainer.images.rgb(frame)), 0.2)
            + 0.01 * (len(times) - 1) * _square(there.position_offsets(0) - here.position_offsets(0))
            + 0.001 * _square(here.offsets(0))
            + 0.01 * _square(composition.residual)
        )
        torch.testing.assert_close(found.total, expected, rtol=1e-5, atol=1e-8)


def test_l_pho_is_four_fifths_l1_and_one_fifth_d_ssim() -> None:
    random = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 20, 24, 3, generator=random)
    l1, whole = functional.l1_loss(image, target), photometric(image, target, 1.0)
    torch.testing.assert_close(photometric(image, target, 0.2), 0.8 * l1 + 0.2 * whole)


def test_the_loss_of_the_warm_up_is_photometric_alone(micro: Path) -> None:
    trainer = paper_trainer(micro)
    frame = trainer.capture.train[0]
    composition = trainer.scene.compose(frame.camera.center, frame.time)
    loss = trainer.objective(
        trainer.scene, [frame], [composition], [draw(composition, frame.camera, (1.0, 1.0, 1.0))], 1
    )
    assert torch.equal(loss.total, loss.photometric.mean())
    assert torch.equal(loss.total, loss.without_squared)


# Growth and pruning


def _many_candidates() -> tuple[Scene, DensityStatistics]:
    scene = paper_scene(anchors=1_500)
    statistics = DensityStatistics(1_500, 3)
    statistics.gradient.fill_(50.0)
    statistics.drawn.fill_(50)
    return scene, statistics


@pytest.mark.parametrize(("preset", "limited"), [("paper", False), ("long", True)])
def test_every_candidate_becomes_an_anchor(preset: str, limited: bool) -> None:
    scene, statistics = _many_candidates()
    config = make_config(preset, {"density.max_anchors": None}).density
    generator = torch.Generator().manual_seed(0)
    grown = grow(scene.scaffold, statistics, torch.ones(1_500, 3), config, VOXEL, 9_999, generator)
    assert grown.capped == limited
    assert (len(grown) > MIN_GROWTH) == (not limited)


def test_a_new_anchor_has_the_feature_of_its_parent_no_offsets_and_low_opacity() -> None:
    scene, statistics = _many_candidates()
    statistics.gradient.fill_(0.0)
    statistics.gradient[7, 1] = 50.0
    config = make_config("paper").density.model_copy(update={"max_anchors": None})
    rows: dict[str, Tensor] = {}
    for seed in range(20):  # a candidate is kept at random
        generator = torch.Generator().manual_seed(seed)
        rows = grow(scene.scaffold, statistics, torch.full((1_500, 3), 2.0), config, VOXEL, 9_999, generator).rows
        if len(rows["anchors"]):
            break
    assert len(rows["anchors"]) >= 1
    assert torch.equal(rows["features"][0], scene.scaffold.features[7])
    assert not rows["offsets"].any()
    torch.testing.assert_close(torch.tanh(2.0 + rows["opacity_offsets"]), torch.full_like(rows["opacity_offsets"], 0.1))


def test_anchors_are_updated_every_100_iterations_and_pruned_in_the_last_fifth_only() -> None:
    control = DensityControl(make_config("paper"), paper_scene(), VOXEL)
    iterations = range(1, 30_001)
    assert [one for one in iterations if control.grows(one)] == list(range(1_500, 20_001, 100))
    assert next(one for one in iterations if control.watches(one)) == 501
    assert next(one for one in iterations if control.prunes(one)) >= 3_000 + 0.8 * 27_000


@pytest.mark.parametrize(("most", "pruned"), [(None, False), (16, True)])
def test_growth_prunes_nothing_even_where_memory_is_nearly_used_up(most: int | None, pruned: bool) -> None:
    config = make_config("paper", {"density.max_anchors": most, "density.memory_mb": 1})
    scene = paper_scene(anchors=40)
    control = DensityControl(config, scene, VOXEL)
    assert scene.scaffold.count > control.most
    control.statistics.visits.fill_(100)  # and no opacity in any of them
    control.statistics.opacity[:20] = 100.0
    control.grow(1_500, scene, Optimizer(scene, config, joint_from=3_000), torch.Generator().manual_seed(0))
    assert (scene.scaffold.count < 40) == pruned


# Training as a whole


def _run_config(**changes: object) -> TrainConfig:
    growing: dict[str, object] = {
        "density.grow_every": 10,
        "density.grow_from": 3_000,
        "density.gradient_threshold": 1e-6,
        "iterations": 60,
    }
    return make_config("paper", {**tiny_paper(), "preset": "paper", **growing, **changes})


@pytest.mark.slow(reason="two trainings with checkpoints")
def test_a_resumed_run_with_learned_anchors_has_the_same_bits(micro: Path, tmp_path: Path) -> None:
    grown = 0
    for report in (whole := TrainingRun.create(micro, tmp_path / "whole", _run_config())):
        grown += sum(event.kind == "grew" for event in report.events)
    assert grown > 1
    run = TrainingRun.create(micro, tmp_path / "parts", _run_config())
    for report in run:
        if report.iteration == 33:
            break
    run.save()
    for _ in (resumed := TrainingRun.resume(tmp_path / "parts", threads=1)):
        pass
    expected, found = (one._trainer.scene.state_dict() for one in (whole, resumed))
    assert expected.keys() == found.keys()
    assert all(torch.equal(expected[name], found[name]) for name in expected)


def test_training_moves_anchors_in_both_phases_and_neither_averages_nor_restarts(micro: Path) -> None:
    trainer = paper_trainer(micro, **{"density.grow_until": 0})
    before = trainer.scene.scaffold.anchors.detach().clone()
    steps(trainer, 10)
    warm = trainer.scene.scaffold.anchors.detach().clone()
    steps(trainer, 190)
    assert not torch.equal(before, warm)
    assert trainer.iteration == 200
    assert trainer.average.steps == 0
    assert trainer.window.share(1) == 1


def test_the_rate_of_anchors_is_relative_to_the_extent(micro: Path) -> None:
    trainer = paper_trainer(micro)
    trainer.step()
    (group,) = (one for one in trainer.optimizer.adam.param_groups if one["name"] == "anchors")
    assert group["lr"] == pytest.approx(6e-4 * float(trainer.scene.extent), rel=0.05)
    assert float(trainer.scene.extent) != 1.0


# The guard skips, and does nothing else


@pytest.mark.parametrize("skip_only", [True, False])
def test_large_gradients_and_a_growing_loss_pass(skip_only: bool) -> None:
    guard = Guard(GuardConfig(skip_only=skip_only, patience=20))
    usual, large = ([Gradient("p", "g", torch.full((1,), size))] for size in (1.0, 1e6))
    for iteration in range(MIN_NORMS):
        guard.check_step(iteration, torch.tensor(0.1), usual)
    limits, problems = [], []
    for iteration in range(300):
        limits.append(guard.check_step(MIN_NORMS + iteration, torch.tensor(1e3), large).limits)
        problems.append(guard.problem())
    assert any(limits) != skip_only
    assert any(problems) != skip_only


def test_a_step_that_is_not_finite_is_skipped_and_changes_nothing(micro: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = paper_trainer(micro)
    steps(trainer, 30)
    before = {name: values.detach().clone() for name, values in trainer.scene.named_parameters()}
    spoil_loss(monkeypatch, trainer, lambda iteration: iteration == 31)
    reports = steps(trainer, 1)
    assert [event.kind for event in events_of(reports)] == ["skipped"]
    assert all(torch.equal(values, before[name]) for name, values in trainer.scene.named_parameters())
    assert events_of(steps(trainer, 5), "skipped") == []


def test_training_that_cannot_go_on_ends_without_a_rollback(micro: Path) -> None:
    trainer = paper_trainer(micro)
    steps(trainer, 30)
    spoil_gradient(trainer, "scaffold.anchors", lambda _: True, lambda values: values * float("nan"))
    reports = steps(trainer, 2)
    with pytest.raises(DivergedError):
        trainer.step()
    assert [event.kind for event in events_of(reports)] == ["skipped", "skipped"]


@pytest.mark.parametrize("skip_only", [True, False])
def test_vanished_opacity_is_not_raised(micro: Path, skip_only: bool) -> None:
    trainer = paper_trainer(micro, **{"guard.skip_only": skip_only})
    with torch.no_grad():
        trainer.scene.appearance.opacity[-1].bias.fill_(-3.0)  # type: ignore[union-attr]
    reports = steps(trainer, 2 * len(trainer.capture.train))
    assert bool(events_of(reports, "opacity_reset")) != skip_only
