"""Training under fire: the E cases of the numerics matrix, each provoked in a real trainer on a tiny capture.

E15 and E16 are tests of `tests.scene.test_scene` and `tests.training.test_run`, E17 and E21 of `test_run` and
`test_diverged`, E08 and the longer half of E07 of `test_spread`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from graings.errors import DivergedError
from graings.raster.rasterize import rasterize
from graings.render import draw, render
from graings.report.events import Event
from graings.scene.memory import bytes_per_anchor
from graings.storage.checkpoint import load_model
from graings.training.density.budget import affordable_anchors
from graings.training.density.growth import MIN_ANCHORS
from graings.training.run import TrainingRun
from graings.training.trainer import Trainer
from tests.scenes import overlapping
from tests.training.micro import (
    GROWING,
    events_of,
    everywhere,
    finite,
    first,
    micro_config,
    micro_trainer,
    plain_training,
    quality,
    spoil_gradient,
    spoil_loss,
    steps,
)

BAD = float("nan")
BIAS = "appearance.color.2.bias"


@pytest.fixture(scope="module")
def clean(micro: Path) -> float:
    """Quality of a run that nothing disturbs."""
    trainer = micro_trainer(micro)
    steps(trainer, 200)
    assert (trainer.guard.skipped, trainer.guard.clipped, trainer.guard.rollbacks) == (0, 0, 0)
    return quality(trainer)


@pytest.mark.parametrize("bad", [BAD, float("inf")])
@pytest.mark.parametrize("name", [BIAS, "scaffold.features", "static.out.weight"])
def test_a_bad_gradient_is_skipped_before_the_optimiser_sees_it(micro: Path, name: str, bad: float) -> None:
    """E02, gradient: parameters, moments and statistics are bit for bit what they were."""
    trainer = micro_trainer(micro)
    steps(trainer, 10)
    spoil_gradient(trainer, name, lambda i: i == 11, lambda gradient: first(gradient, bad))
    before = {key: value.clone() for key, value in trainer.scene.state_dict().items()}
    moments = {key: value.clone() for key, value in trainer.optimizer.state().items()}
    events = events_of(steps(trainer, 1), "skipped")
    assert len(events) == 1
    assert name in events[0].non_finite
    assert all(torch.equal(value, before[key]) for key, value in trainer.scene.state_dict().items())
    assert all(torch.equal(value, moments[key]) for key, value in trainer.optimizer.state().items())
    steps(trainer, 1)
    assert any(not torch.equal(value, before[key]) for key, value in trainer.scene.state_dict().items())


def test_a_run_with_a_bad_gradient_is_as_good_as_a_clean_one(micro: Path, clean: float) -> None:
    """E02, gradient at step 50."""
    trainer = micro_trainer(micro)
    spoil_gradient(trainer, BIAS, lambda i: i == 50, lambda gradient: first(gradient, BAD))
    assert len(events_of(steps(trainer, 200), "skipped")) == 1
    assert (trainer.guard.skipped, trainer.guard.rollbacks) == (1, 0)
    assert quality(trainer) > clean - 0.5


def test_a_run_with_a_bad_loss_is_as_good_as_a_clean_one(
    micro: Path, clean: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """E02, loss at step 50."""
    trainer = micro_trainer(micro)
    spoil_loss(monkeypatch, trainer, lambda i: i == 50)
    assert events_of(steps(trainer, 200), "skipped")[0].non_finite == "the loss"
    assert quality(trainer) > clean - 0.5


@pytest.mark.parametrize(
    "moment",
    ["exp_avg", pytest.param("exp_avg_sq", marks=pytest.mark.slow(reason="400 steps more for the other moment"))],
)
def test_a_bad_moment_estimate_is_detected_and_training_rolls_back(micro: Path, moment: str) -> None:
    """E02, one number of Adam's state at step 52: it reaches the parameter, not the model that is kept.

    Half the rates, and the steps thrown away, cost a run this short; going back must cost none beyond those.
    """
    slower = micro_trainer(micro)
    steps(slower, 50)
    slower.optimizer.damping = 0.5
    slower.iteration = 55  # detected here: the schedule continues, the five steps are not repeated
    steps(slower, 145)
    trainer = micro_trainer(micro)
    steps(trainer, 52)
    trainer.optimizer.adam.state[trainer.scene.scaffold.features][moment][3, 2] = BAD
    events = events_of(steps(trainer, 3), "rolled_back")
    assert [event.to_iteration for event in events] == [50]
    assert finite(trainer)
    assert trainer.guard.rollbacks == 1
    steps(trainer, 145)
    assert quality(trainer) > quality(slower) - 0.5


def test_three_bad_steps_in_a_row_restore_scene_moments_streams_and_statistics(
    micro: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = micro_trainer(micro, **{"density.statistics_from": 0, "density.grow_until": 20_000})
    steps(trainer, 25)
    tensors, facts = trainer.state()
    good = copy.deepcopy((trainer.scene.state_dict(), tensors, facts))
    steps(trainer, 3)
    spoil_loss(monkeypatch, trainer, lambda i: i > 28)
    reports = steps(trainer, 3)
    (event,) = events_of(reports, "rolled_back")
    assert (event.to_iteration, event.reason) == (25, "the loss was not finite in 3 steps in a row")
    scene, (tensors, facts) = trainer.scene.state_dict(), trainer.state()
    assert all(torch.equal(scene[name], good[0][name]) for name in good[0])
    same = [name for name in good[1] if not name.startswith("sampler")]
    assert any(name.startswith("adam/") for name in same)
    assert any(name.startswith("statistics/") for name in same)
    assert all(torch.equal(tensors[name], good[1][name]) for name in same)
    assert trainer.iteration == 31  # spent iterations stay spent
    assert trainer.guard.skipped == 3
    # Half the rates, and views in an order of their own.
    assert trainer.optimizer.damping == 0.5
    assert trainer.views.sampler.generator is trainer.streams["sampler.1"]


def test_repeated_rollbacks_go_further_back_and_end_in_divergence(micro: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = micro_trainer(micro)
    steps(trainer, 60)
    spoil_loss(monkeypatch, trainer, lambda i: i > 60)
    reports = [trainer.step() for _ in range(11)]
    with pytest.raises(DivergedError, match="after 3 rollbacks: the loss was not finite"):
        trainer.step()
    assert [event.to_iteration for event in events_of(reports, "rolled_back")] == [50, 25, 25]
    assert trainer.iteration == 72
    trainer.restore()
    assert trainer.iteration == 25
    assert finite(trainer)


def test_a_growing_finite_loss_rolls_back(micro: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = micro_trainer(micro, **{"guard.patience": 20})
    steps(trainer, 100)
    spoil_loss(monkeypatch, trainer, lambda i: i > 100, factor=50.0)
    events = events_of(steps(trainer, 60), "rolled_back")
    assert events
    assert events[0].reason.startswith("the mean loss was")
    assert events[0].to_iteration == 100  # and not to a moment taken when the loss was already running away


@pytest.mark.slow(reason="500 steps; test_diverged has runs that diverge")
def test_a_hundredfold_rate_ends_converged_or_diverged_with_a_model_that_renders(micro: Path, tmp_path: Path) -> None:
    """E01: 500 iterations."""
    rates = {
        f"rates.{name}": [100 * value for value in pair] for name, pair in micro_config().rates.model_dump().items()
    }
    config = micro_config(iterations=500, **rates, **{"guard.patience": 50})
    diverged = False
    try:
        for report in TrainingRun.create(micro, tmp_path / "run", config):
            assert report.evaluation is None or math.isfinite(report.evaluation.psnr)
    except DivergedError:
        diverged = True
    model = load_model(tmp_path / "run")
    assert all(bool(tensor.isfinite().all()) for tensor in model.scene.state_dict().values())
    view = model.views["val"][0]
    assert bool(render(model.scene, view.camera, view.time, model.background).color.isfinite().all())
    assert model.finished is not diverged


def test_a_finite_spike_is_clipped_and_does_not_freeze_its_parameter(micro: Path) -> None:
    """E03: 1e10 in one entry; the updates of that entry afterwards against those of its undisturbed neighbour."""
    trainer = micro_trainer(micro, iterations=300)
    # Where all gradients are the same, the normal size of an update is the rate.
    spoil_gradient(trainer, BIAS, lambda i: i != 60, everywhere(0.01))
    spoil_gradient(trainer, BIAS, lambda i: i == 60, lambda gradient: first(everywhere(0.01)(gradient), 1e10))
    steps(trainer, 59)
    (event,) = events_of(steps(trainer, 1), "clipped")
    assert (event.group, f"{event.norm:.3g}") == ("color", "1e+10")
    values = dict(trainer.scene.named_parameters())[BIAS]
    ratios = []
    for iteration in range(61, 261):
        before = values.detach().clone()
        trainer.step()
        moved = (values.detach() - before).abs()
        ratios.append(float(moved[0]) / trainer.optimizer.rate("color", iteration))
        assert float(moved[1]) >= 0.2 * trainer.optimizer.rate("color", iteration)
    assert min(ratios) >= 0.2


@pytest.mark.slow(reason="300 steps; a spike in a vector has the test above")
def test_a_finite_spike_does_not_stop_the_rest_of_its_matrix(micro: Path) -> None:
    """E03 where singular values are made equal: 1e10 in one entry; the next 200 updates of all other entries.

    E03 asks for a fifth of the usual size; an entry limited by its own matrix leaves them three quarters and more.
    """
    trainer = micro_trainer(micro, iterations=300)
    name = "deformation.hidden.0.weight"
    spoil_gradient(trainer, name, lambda i: i == 100, lambda gradient: first(gradient, 1e10))
    matrix = dict(trainer.scene.named_parameters())[name]
    sizes = []
    for iteration in range(1, 301):
        before = matrix.detach().clone()
        events = trainer.step().events
        moved = (matrix.detach() - before)[1:, 1:].square().mean().sqrt()
        sizes.append(float(moved) / trainer.optimizer.rate("matrices", iteration, like="deformation"))
        if iteration == 100:
            assert len(events) == 1
            assert (events[0].kind, events[0].group) == ("clipped", "deformation")
            assert f"{events[0].norm:.3g}" == "1e+10"
    normal = sum(sizes[60:99]) / 39
    assert min(sizes[100:]) >= 0.5 * normal
    assert finite(trainer)


@pytest.mark.parametrize(("number", "drift"), [(0.0, 0.0), (1e-25, 1e-8)])
def test_zero_and_tiny_gradients_do_not_change_parameters(micro: Path, number: float, drift: float) -> None:
    """E04: 100 steps."""
    trainer = micro_trainer(micro)
    before = {name: value.detach().clone() for name, value in trainer.scene.named_parameters()}
    for name in before:
        spoil_gradient(trainer, name, lambda _: True, everywhere(number))
    assert {event.kind for event in events_of(steps(trainer, 100))} <= {"initial_points"}
    assert finite(trainer)
    for name, value in trainer.scene.named_parameters():
        assert float((value.detach() - before[name]).abs().max()) <= drift, name


def _peak_bytes() -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM")))


@pytest.mark.parametrize("batch", [1, 4])
def test_growth_stops_at_the_budget(micro: Path, batch: int) -> None:
    """E05: everything grows on six levels; the budget is that of the memory, and the memory is not exceeded."""
    memory_mb = 4
    trainer = micro_trainer(
        micro,
        batch=batch,
        **{
            "density.gradient_threshold": 1e-30,
            "density.levels": 6,
            "density.grow_from": 0,
            "density.grow_until": 30_000,
            "density.grow_every": 5,
            "density.min_observations": 0,
            "density.statistics_from": 0,
            "density.memory_mb": memory_mb,
            "density.prune_min_views": 10_000,  # nothing makes room
        },
    )
    most = affordable_anchors(trainer.config.scene, batch, memory_mb)
    assert trainer.scene.scaffold.count < most < trainer.config.density.max_anchors
    steps(trainer, 2)
    Path("/proc/self/clear_refs").write_text("5")  # the peak is counted from here on
    start = _peak_bytes()
    reports = steps(trainer, 48)
    assert trainer.scene.scaffold.count == most
    assert events_of(reports, "growth_capped")
    assert _peak_bytes() - start < memory_mb * 1_000_000
    assert finite(trainer)


def test_faint_anchors_are_pruned_to_make_room_for_growth(micro: Path) -> None:
    growing = {"density.statistics_from": 0, "density.grow_from": 0, "density.grow_until": 30_000}
    eager = {"density.grow_every": 10, "density.gradient_threshold": 1e-9, "density.prune_min_views": 15}
    trainer = micro_trainer(micro, **growing, **eager, **{"density.max_anchors": 60})
    scaffold = trainer.scene.scaffold
    count, showing = scaffold.count, 40
    assert count > 60, "more anchors than the budget from the first step on, as a dense cloud gives"
    with torch.no_grad():
        scaffold.opacity_offsets[showing:] = -5.0
    reports = steps(trainer, 60)
    uids = set(trainer.scene.scaffold.uids.tolist())
    assert events_of(reports, "pruned")
    assert uids.isdisjoint(range(showing, count))
    assert max(uids) >= count, "something was born in their place"
    assert len(uids) <= 60


@pytest.mark.slow(reason="compares the quality of two trainings of 400 steps")
def test_initial_anchors_above_the_budget_are_thinned(micro: Path) -> None:
    growing = {"density.statistics_from": 0, "density.grow_from": 0, "density.grow_until": 30_000}
    eager = {"density.grow_every": 10, "density.prune_min_views": 15}
    found = {}
    for most in (40, 20_000):
        trainer = micro_trainer(micro, iterations=400, **growing, **eager, **{"density.max_anchors": most})
        assert trainer.scene.scaffold.count > 40, "as a floor that nobody looks at has"
        reports = steps(trainer, 400)
        found[most] = quality(trainer)
        assert len(events_of(reports, "thinned")) == (1 if most == 40 else 0)
        assert trainer.scene.scaffold.count <= most
        if most == 40:
            after = next(i for i, report in enumerate(reports) if events_of([report], "thinned"))
            assert events_of(reports[after + 1 :], "grew"), "there is room again"
    print(f"with 40 anchors {found[40]:.2f} dB, with as many as it likes {found[20_000]:.2f} dB")
    assert found[40] > found[20_000] - 3


def test_a_larger_scene_costs_more_of_the_budget() -> None:
    small, large = micro_config().scene, micro_config(**{"scene.children": 10, "scene.deform_width": 256}).scene
    assert bytes_per_anchor(large, 1) > 3 * bytes_per_anchor(small, 1)
    assert affordable_anchors(large, 1, 1) >= 16


def test_pruning_everything_leaves_a_scene_to_train(micro: Path) -> None:
    """E06."""
    trainer = micro_trainer(
        micro,
        **{
            "density.prune_from": 0,
            "density.prune_until": 30_000,
            "density.prune_every": 300,
            "density.prune_opacity": 1e9,
            "density.prune_min_views": 1,
            "density.statistics_from": 0,
        },
    )
    start = trainer.scene.scaffold.count
    steps(trainer, 40)
    assert trainer.scene.scaffold.count >= min(MIN_ANCHORS, start)
    before = quality(trainer)
    steps(trainer, 60)
    assert quality(trainer) > before


def test_single_and_double_precision_learn_alike(micro: Path) -> None:
    """E07, 50 iterations without growth: losses and not parameters, whose paths are chaotic."""
    trainer = micro_trainer(micro)
    single, double = (plain_training(trainer, dtype, 50)[1] for dtype in (torch.float32, torch.float64))
    assert single[-1] < 0.7 * single[0]
    assert max(abs(a - b) / b for a, b in zip(single, double, strict=True)) < 1e-2
    assert abs(single[0] - double[0]) / double[0] < 1e-5


@pytest.mark.parametrize(
    ("bias", "projected"),
    [
        (3.0, True),
        pytest.param(-3.0, False, marks=pytest.mark.slow(reason="230 steps more for the other combinations")),
        pytest.param(3.0, False, marks=pytest.mark.slow(reason="230 steps more for the other combinations")),
        pytest.param(-3.0, True, marks=pytest.mark.slow(reason="230 steps more for the other combinations")),
    ],
)
def test_a_log_scale_beyond_its_clip_recovers(micro: Path, bias: float, projected: bool) -> None:
    """E09: by the image where the gradient is projected, by the regulariser alone where it is not."""
    options = {"scene.projected_clip": projected, "rates.deformation": [0.005, 0.005], "loss.deformation": 0.01}
    trainer = micro_trainer(micro, iterations=400, warmup=0, **options)
    steps(trainer, 30)
    assert trainer.scene.deformation is not None
    with torch.no_grad():
        trainer.scene.deformation.out.bias[7:] = bias
    steps(trainer, 200)
    frame = trainer.capture.train[0]
    moved = trainer.scene.compose(frame.camera.center, frame.time).deformation
    assert moved is not None
    assert float(moved.outputs[..., 7:].detach().abs().median()) < 2.0


def _drive(trainer: Trainer, layer: nn.Module, bias: float) -> None:
    assert isinstance(layer, nn.Linear)
    with torch.no_grad():
        layer.bias.fill_(bias)


@pytest.mark.parametrize(
    ("bias", "ground"),
    [
        (20.0, "black"),
        pytest.param(-20.0, "white", marks=pytest.mark.slow(reason="as many steps again for the other sign")),
    ],
)
def test_saturated_colours_recover(micro: Path, bias: float, ground: str) -> None:
    """E10: logits at 20 give a gradient of exactly 0 where it is formed from the value.

    Biases may stay where they are: what brings the colours back is mostly the weights. The ground is of the other
    colour: what is white before white may stay so, and rounding decides how much does.
    """
    trainer = micro_trainer(micro, **{"rates.color": [0.1, 0.1], "capture.background": ground})
    _drive(trainer, trainer.scene.appearance.color[-1], bias)
    frame = trainer.capture.train[0]

    def moderate() -> float:
        colors = trainer.scene.compose(frame.camera.center, frame.time).gaussians.colors
        return float(((colors > 1e-3) & (colors < 1 - 1e-3)).float().mean())

    before = quality(trainer)
    assert moderate() == 0
    steps(trainer, 200)
    assert moderate() > 0.2
    assert quality(trainer) > before + 5


def test_a_saturated_opacity_has_a_gradient_and_falls_where_the_data_want_it(micro: Path) -> None:
    """E11: at 20 the gradient is there; from 12 on it is large enough for Adam's epsilon.

    A step changes an opacity logit by its rate times the number of active hidden units: at 0.05, 96 of them reach 40.
    """
    trainer = micro_trainer(micro, **{"rates.opacity": [0.016, 0.016]})
    last = trainer.scene.appearance.opacity[-1]
    assert isinstance(last, nn.Linear)
    _drive(trainer, last, 20.0)
    frame = trainer.capture.train[0]
    drawn = draw(trainer.scene.compose(frame.camera.center, frame.time), frame.camera, trainer.background)
    drawn.alpha.sum().backward()
    assert last.bias.grad is not None
    assert float(last.bias.grad.max()) > 0
    last.bias.grad = None
    trainer.optimizer.clear()
    _drive(trainer, last, 12.0)
    before = quality(trainer)
    steps(trainer, 200)
    composed = trainer.scene.compose(frame.camera.center, frame.time)
    assert float(composed.opacities.min()) < 0.5  # of every slot; at a bias of 12 each is 1
    assert quality(trainer) > before + 10


def test_a_collapsed_scene_gets_its_opacity_raised_once_and_then_rolls_back(micro: Path) -> None:
    """E12."""
    trainer = micro_trainer(micro)
    last = trainer.scene.appearance.opacity[-1]
    assert isinstance(last, nn.Linear)
    _drive(trainer, last, -3.0)
    before = quality(trainer)
    reports = steps(trainer, 6)
    assert [report.gaussians for report in reports] == [0] * 6
    assert len(events_of(reports, "opacity_reset")) == 1
    assert trainer.step().gaussians > 0
    assert events_of(steps(trainer, 120), "opacity_reset") == []
    assert quality(trainer) > before + 3
    _drive(trainer, trainer.scene.appearance.opacity[-1], -3.0)
    again = steps(trainer, 20)
    assert events_of(again, "opacity_reset") == []
    (event,) = events_of(again, "rolled_back")
    assert event.to_iteration == 125
    assert event.reason.startswith("no Gaussian was drawn any more")


def _noisy_rotations(capture: Path, count: int) -> Iterator[tuple[int, Tensor]]:
    """E13: the residual that cancels the identity, then noise in every step; lengths of all quaternions as they go."""
    trainer = micro_trainer(capture, warmup=0, iterations=max(count, 200))
    assert trainer.scene.deformation is not None
    bias = trainer.scene.deformation.out.bias
    with torch.no_grad():
        bias[3] = -1.0
    noise = torch.Generator().manual_seed(0)
    frame = trainer.capture.train[0]
    for step in range(1, count + 1):
        trainer.step()
        with torch.no_grad():
            bias[3:7] += 0.01 * torch.randn(4, generator=noise)
            if step % 50 == 0:
                composition = trainer.scene.compose(frame.camera.center, frame.time)
                assert draw(composition, frame.camera, trainer.background).culled["zero_quat"] == 0
                yield step, composition.gaussians.quats.norm(dim=-1)
    assert finite(trainer)
    assert trainer.guard.rollbacks == 0


def test_a_rotation_at_the_zero_quaternion_is_finite_and_leaves_it(micro: Path) -> None:
    """E13, its first steps: away from a length of 0.03."""
    for _, lengths in _noisy_rotations(micro, 150):
        assert bool(((lengths > 0.01) & (lengths < 10)).all())


@pytest.mark.slow(reason="10,000 steps")
def test_ten_thousand_noisy_steps_leave_rotations_well_inside_their_bounds(micro: Path) -> None:
    """E13, all of it: once they have left zero, lengths between 0.1 and 10."""
    seen = 0
    for step, lengths in _noisy_rotations(micro, 10_000):
        if step >= 1_000:
            assert bool(((lengths > 0.1) & (lengths < 10)).all()), f"step {step}: {lengths.min()} to {lengths.max()}"
            seen += len(lengths)
    assert seen > 0


def test_a_quaternion_and_its_negative_draw_the_same_bits() -> None:
    """E14."""
    batch, camera = overlapping()
    white = torch.ones(3, dtype=torch.float64)
    images = [rasterize(replace(batch, quats=sign * batch.quats), camera, white).color for sign in (1, -1)]
    assert torch.equal(*images)


def test_children_created_at_one_position_separate(micro: Path) -> None:
    """E18: 100 iterations after the birth of anchors with zero offsets, of which some view has seen something."""
    trainer = micro_trainer(micro, **GROWING)
    old = trainer.density.next_uid
    assert events_of(steps(trainer, 100), "grew")
    steps(trainer, 100)
    moments = trainer.optimizer.adam.state[trainer.scene.scaffold.offsets]["exp_avg_sq"]
    born = (trainer.scene.scaffold.uids >= old) & (moments > 0).flatten(1).all(1)
    assert bool(born.any())
    offsets = trainer.scene.scaffold.offsets.detach()[born]
    apart = torch.cdist(offsets, offsets) + torch.eye(offsets.shape[1])
    assert float(apart.min()) > 0


@pytest.mark.parametrize("newborn", [None, 0.02])
def test_growth_hardly_changes_the_image(micro: Path, monkeypatch: pytest.MonkeyPatch, newborn: float | None) -> None:
    """E19: quality right before and right after each growth; newborns as opaque as their parent, and faint ones."""
    trainer = micro_trainer(micro, **GROWING, **{"density.new_anchor_opacity": newborn})
    drops: list[float] = []
    grow = trainer.density.grow

    def measured(*arguments: Any) -> tuple[int, list[Event]]:
        before = quality(trainer)
        born, events = grow(*arguments)
        if events:
            drops.append(before - quality(trainer))
        return born, events

    monkeypatch.setattr(trainer.density, "grow", measured)
    steps(trainer, 110)
    assert drops
    assert max(drops) <= 0.5


def test_a_saved_scene_renders_the_same_bits(micro: Path, tmp_path: Path) -> None:
    """E20, float32."""
    run = TrainingRun.create(micro, tmp_path / "run", micro_config(iterations=30))
    list(run)
    model = load_model(tmp_path / "run")
    frame = run.capture.train[2]
    images = [
        render(scene, frame.camera, frame.time, model.background).color for scene in (run._trainer.scene, model.scene)
    ]
    assert torch.equal(*images)
