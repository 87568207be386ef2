"""What training leaves out: a residual that does not show, growth where nothing grows; and what stays as it is."""

from __future__ import annotations

import copy
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from graings.capture.synthetic import write_synthetic
from graings.errors import DivergedError
from graings.plan.capture_statistics import measure
from graings.plan.cost import Prediction
from graings.plan.plan import make_plan
from graings.plan.rules import QUIET_GROWTHS
from graings.plan.tile_change import HALF_LEVEL
from graings.render import render
from graings.report.events import Diverged, Grew, GrowthQuiet, PartDropped, Restarted, RolledBack
from graings.report.metrics_document import read_metrics
from graings.report.run_record import read_plan, read_record
from graings.scene.scene import Scene
from graings.storage.checkpoint import load_model
from graings.storage.files import write_document
from graings.storage.run_folder import RECORD_FILE
from graings.training.curriculum import missing_motion
from graings.training.curriculum.missing_motion import MissingMotion
from graings.training.residual_bound import residual_bound
from graings.training.run import TrainingRun
from graings.training.timing import evaluation_marks
from graings.training.trainer import Trainer
from graings.training.view_dependence import view_dependence
from tests.capture.captures import entry, orbit, write_image, write_transforms
from tests.plan.fixed_cameras import texture, write_fixed
from tests.training.micro import GROWING, micro_config, micro_trainer, steps

FROZEN = {"rates.residual": (0.0, 0.0)}  # it stays at zero
OFTEN = {"evaluation.first": 10, "evaluation.factor": 1.2, "iterations": 100, "plan.mode": "safe"}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic(tmp_path_factory.mktemp("capture") / "tiny", seed=1, frames=8, size=24, bodies=2)


def dropped_at(run: Path) -> list[int]:
    events = read_metrics(run / "metrics.json").events
    return [event.iteration for event in events if isinstance(event, PartDropped)]


def parameters(scene: Scene) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in scene.named_parameters()}


def with_residual(trainer: Trainer, size: float) -> Scene:
    """A trained scene whose residual has outputs of about `size`."""
    scene = copy.deepcopy(trainer.scene)
    scene.temporal = True
    assert scene.residual is not None
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for head in (scene.residual, scene.residual.seeing):
            if head is not None:
                head.out.weight.copy_(size * torch.randn(head.out.weight.shape, generator=generator))
    return scene


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("size", [1e-3, 1e-2, 0.3])
def test_the_bound_is_not_less_than_what_leaving_the_residual_out_changes(
    capture: Path, size: float, degree: int
) -> None:
    trainer = micro_trainer(capture, **{"scene.residual_sh_degree": degree})
    steps(trainer, 60)
    scene, frames = with_residual(trainer, size), trainer.capture.train
    bound = residual_bound(scene, frames, trainer.background, limit=9.0)
    without = copy.deepcopy(scene)
    without.residual = None
    changes = [
        (one.color - other.color).abs().max()
        for one, other in (
            [render(s, frame.camera, frame.time, trainer.background) for s in (scene, without)] for frame in frames
        )
    ]
    assert 0 < float(torch.stack(changes).max()) <= bound
    assert scene.residual is not None


def test_the_bound_ends_at_the_first_view_above_the_limit(capture: Path) -> None:
    trainer = micro_trainer(capture)
    steps(trainer, 60)
    scene = with_residual(trainer, 0.3)
    seen = []
    bound = residual_bound(
        scene, (seen.append(frame) or frame for frame in trainer.capture.train), trainer.background, HALF_LEVEL
    )
    assert bound > HALF_LEVEL
    assert len(seen) == 1


def test_a_residual_that_shows_nothing_is_left_out_and_the_plan_says_so(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", micro_config(**OFTEN, **FROZEN))
    reports = list(run)
    dropped = [event for report in reports for event in report.events if isinstance(event, PartDropped)]
    assert [(event.component, event.bound) for event in dropped] == [("residual", 0.0)]
    first = run.config.scaled(run.config.warmup) + run.config.scaled(2_000)
    assert dropped[0].iteration > first  # PT12: two evaluations after it may be judged
    assert load_model(tmp_path / "run").scene.residual is None
    plan = read_plan(tmp_path / "run")
    assert plan is not None
    assert plan == read_metrics(tmp_path / "run" / "metrics.json").plan
    decision = plan.decision("residual")
    assert decision is not None
    assert (decision.decision, decision.iteration) == ("drop", dropped[0].iteration)
    assert decision.saving is not None
    assert decision.saving.measured_s is not None


@pytest.mark.parametrize(
    "option", [{"plan.keep": ["residual"]}, {"plan.mode": "off"}, {"rates.residual": (0.05, 0.05)}], ids=str
)
def test_a_residual_that_shows_or_is_to_be_kept_stays(capture: Path, tmp_path: Path, option: dict[str, object]) -> None:
    options = {**OFTEN, **FROZEN, **option}
    assert not [e for r in TrainingRun.create(capture, tmp_path / "run", micro_config(**options)) for e in r.events
                if isinstance(e, PartDropped)]  # fmt: skip
    assert load_model(tmp_path / "run").scene.residual is not None


def test_leaving_out_the_residual_keeps_the_picture_and_the_random_numbers_of_the_rest(
    capture: Path, tmp_path: Path
) -> None:
    """PT13. Sums of the colour head's gradients have fewer rows of zeros, so its weights differ in the last bits."""
    runs = []
    for name, option in (("kept", {"plan.keep": ["residual"]}), ("dropped", {})):
        run = TrainingRun.create(capture, tmp_path / name, micro_config(**OFTEN, **FROZEN, **option))
        list(run)
        runs.append(run._trainer)
    kept, dropped = runs
    assert {name for name in parameters(kept.scene) if name.startswith("residual.")} == (
        parameters(kept.scene).keys() - parameters(dropped.scene).keys()
    )
    streams = kept.streams.state()
    assert streams.keys() == dropped.streams.state().keys()
    assert all(torch.equal(streams[name], state) for name, state in dropped.streams.state().items())
    frame = kept.capture.train[0]
    one, other = (render(t.scene, frame.camera, frame.time, t.background).color for t in runs)
    assert float((one - other).abs().max()) < 0.02


def test_a_run_resumed_after_the_residual_went_has_the_same_bits(capture: Path, tmp_path: Path) -> None:
    config = micro_config(**OFTEN, **FROZEN)
    list(TrainingRun.create(capture, tmp_path / "whole", config))
    run = TrainingRun.create(capture, tmp_path / "parts", config)
    for report in run:
        if any(isinstance(event, PartDropped) for event in report.events):
            run.save()
            break
    list(TrainingRun.resume(tmp_path / "parts"))
    whole, parts = (parameters(load_model(tmp_path / name).scene) for name in ("whole", "parts"))
    assert whole.keys() == parts.keys()
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    plan = read_plan(tmp_path / "parts")
    assert plan is not None
    assert plan.drops("residual")


@pytest.mark.parametrize("killed", [False, True])
def test_a_run_interrupted_between_two_evaluations_leaves_the_residual_out_when_the_unbroken_one_does(
    capture: Path, tmp_path: Path, killed: bool
) -> None:
    """Stopped after the first that found it below the bound, or killed after the second, before its checkpoint."""
    config = micro_config(**OFTEN, **FROZEN)
    list(TrainingRun.create(capture, tmp_path / "whole", config))
    (dropped,) = dropped_at(tmp_path / "whole")
    run = TrainingRun.create(capture, tmp_path / "parts", config)
    for report in run:
        if report.iteration == dropped - 1:
            assert run.log.residual_unseen == 1
            run.save()
        if report.iteration == dropped - 1 + 2 * killed:
            break
    resumed = TrainingRun.resume(tmp_path / "parts")
    assert not resumed.revision.plan.drops("residual")
    steps_left = iter(resumed)
    next(steps_left)
    assert resumed.revision.plan.drops("residual")
    assert resumed.trainer.scene.residual is None
    list(steps_left)
    assert dropped_at(tmp_path / "parts") == [dropped]
    whole, parts = (parameters(load_model(tmp_path / name).scene) for name in ("whole", "parts"))
    assert whole.keys() == parts.keys()
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    plans = [read_plan(tmp_path / name) for name in ("whole", "parts")]
    decisions = [[d.model_dump(exclude={"saving"}) for d in plan.decisions] for plan in plans if plan is not None]
    assert decisions[0] == decisions[1]


def test_the_plan_on_disk_is_that_of_the_checkpoint_once_a_killed_run_goes_on(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", micro_config(**OFTEN, **FROZEN))
    for report in run:
        if report.iteration == 1:
            run.save()
        if any(isinstance(event, PartDropped) for event in report.events):
            break
    plan = read_plan(tmp_path / "run")
    assert plan is not None
    assert plan.drops("residual")
    next(iter(TrainingRun.resume(tmp_path / "run")))
    plan = read_plan(tmp_path / "run")
    assert plan is not None
    assert not plan.drops("residual")


@pytest.mark.parametrize("diverged", [False, True])
def test_the_plan_is_that_of_the_scene_to_which_training_went_back(
    capture: Path, tmp_path: Path, diverged: bool
) -> None:
    """Rolled back to a snapshot, or to the best model, of before the residual was left out; then at the end too."""
    limits = {"guard.rollbacks": 0} if diverged else {}
    run = TrainingRun.create(capture, tmp_path / "run", micro_config(**OFTEN, **FROZEN, **limits))
    with pytest.raises(DivergedError) if diverged else nullcontext():
        for report in run:
            rolled_back = any(isinstance(event, RolledBack) for event in run.log.events)
            if not rolled_back and any(isinstance(event, PartDropped) for event in report.events):
                with torch.no_grad():
                    run.trainer.scene.scaffold.features[0] = torch.nan
            plan = read_plan(tmp_path / "run")
            assert plan is not None
            assert plan.drops("residual") == (run.trainer.scene.residual is None)
    events = read_metrics(tmp_path / "run" / "metrics.json").events
    assert [type(event) for event in events].index(PartDropped) < [type(event) for event in events].index(
        Diverged if diverged else RolledBack
    )
    plan = read_plan(tmp_path / "run")
    assert plan is not None
    assert plan.drops("residual") == (load_model(tmp_path / "run").scene.residual is None)


def test_a_restart_judges_the_residual_of_the_new_scene_anew(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(missing_motion, "MIN_STEPS", 1)
    monkeypatch.setattr(MissingMotion, "find", lambda *_: MissingMotion(0.5, 0.5))
    run = TrainingRun.create(capture, tmp_path / "run", micro_config(**OFTEN, **FROZEN))
    for report in run:
        if any(isinstance(event, Restarted) for event in report.events):
            break
    restart = run.iteration
    (first,) = [event.iteration for event in run.log.events if isinstance(event, PartDropped)]
    assert first < restart
    plan = read_plan(tmp_path / "run")
    assert plan == run.revision.plan
    decision = run.revision.plan.decision("residual")
    assert decision is not None
    assert decision.decision == "later"
    assert decision.iteration is not None
    assert decision.iteration < first
    run.save()
    list(TrainingRun.resume(tmp_path / "run"))
    judged = [mark - restart for mark in sorted(evaluation_marks(run.config, run.iterations)) if mark > restart]
    second = [mark for mark in judged if mark >= decision.iteration][1]  # two evaluations of the new scene
    assert dropped_at(tmp_path / "run") == [first, restart + second]
    assert load_model(tmp_path / "run").scene.residual is None


@pytest.mark.parametrize("left_out", [{"scene.deformation": "none"}, {"scene.residual": False}], ids=str)
def test_the_warm_up_has_the_same_bits_without_a_part_of_the_joint_phase(
    capture: Path, left_out: dict[str, object]
) -> None:
    """PT13."""
    trainers = [micro_trainer(capture, **GROWING, **options) for options in ({}, left_out)]
    warm_up = trainers[0].phases[0].last
    for trainer in trainers:
        assert trainer.phases[0].name == "warmup"
        steps(trainer, warm_up)
    full, less = (parameters(trainer.scene) for trainer in trainers)
    assert less.keys() < full.keys()
    assert all(torch.equal(full[name], less[name]) for name in less)


def test_an_opaque_alpha_channel_is_left_out_without_changing_a_bit(tmp_path: Path) -> None:
    folder = tmp_path / "c"
    entries = []
    for index in range(6):
        image = np.random.default_rng(index).integers(0, 256, (16, 16, 4), dtype=np.uint8)
        image[..., 3] = 255
        write_image(folder / f"train/r_{index:03d}.png", image)
        entries.append(entry(orbit(index, 6, (16, 16)), f"./train/r_{index:03d}", index / 5))
    write_transforms(folder, "train", entries)
    write_transforms(folder, "val", [])
    found = []
    for options in ({}, {"plan.keep": ["alpha_loss"]}):
        run = TrainingRun.create(folder, tmp_path / str(len(found)), micro_config(iterations=20, **options))
        list(run)
        found.append((run.applied.loss.alpha, parameters(load_model(run.folder).scene)))
    (without, dropped), (with_loss, kept) = found
    assert without == 0.0 < with_loss
    assert all(torch.equal(kept[name], dropped[name]) for name in kept)


QUIET = {
    **GROWING,
    "density.grow_every": 5,
    "density.gradient_threshold": 1e6,
    "iterations": 120,
    "plan.mode": "aggressive",
}


def growth_events(trainer: Trainer) -> list[GrowthQuiet]:
    reports = steps(trainer, trainer.config.iterations)
    return [event for report in reports for event in report.events if isinstance(event, GrowthQuiet)]


@pytest.mark.parametrize(("mode", "ended"), [("aggressive", True), ("safe", False)])
def test_growth_ends_where_nothing_grows_if_aggressive(capture: Path, mode: str, ended: bool) -> None:
    trainer = micro_trainer(capture, **{**QUIET, "plan.mode": mode})
    (event,) = growth_events(trainer)
    assert (event.growths, event.ended) == (QUIET_GROWTHS, ended)
    assert trainer.growth_ended == ended
    trainer.iteration = event.iteration + 1
    assert trainer.watches() != ended


def test_growth_goes_on_where_something_grows_or_it_is_to_be_kept(capture: Path) -> None:
    assert growth_events(micro_trainer(capture, **{**QUIET, "density.gradient_threshold": 1e-9})) == []
    assert growth_events(micro_trainer(capture, **{**QUIET, "plan.keep": ["growth"]})) == []


def test_a_run_stopped_after_its_growth_went_quiet_says_so_in_its_plan(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", micro_config(**QUIET))
    for report in run:
        quiet = [event for event in report.events if isinstance(event, GrowthQuiet)]
        if quiet:
            break
    run.save()
    before = read_plan(tmp_path / "run")
    list(TrainingRun.resume(tmp_path / "run"))
    for plan in (before, read_plan(tmp_path / "run"), read_metrics(tmp_path / "run" / "metrics.json").plan):
        assert plan is not None
        decision = plan.decision("growth")
        assert decision is not None
        assert (decision.decision, decision.iteration) == ("drop", quiet[0].iteration)


def test_growth_that_begins_again_is_in_the_plan_as_it_was(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", micro_config(**{**QUIET, "plan.mode": "safe"}))
    planned = run.revision.plan.decision("growth")
    for report in run:
        if any(isinstance(event, GrowthQuiet) for event in report.events):
            break
    quiet = read_plan(tmp_path / "run")
    assert quiet is not None
    decision = quiet.decision("growth")
    assert decision is not None
    assert (decision.decision, decision.iteration) == ("propose", report.iteration)
    assert decision.reason == f"the {QUIET_GROWTHS} growths up to this iteration added no anchor"
    run.revision.note(replace(report, events=(Grew(iteration=report.iteration + 5, anchors=3),)))
    again = read_plan(tmp_path / "run")
    assert again is not None
    assert again.decision("growth") == planned


def test_a_run_that_was_extended_has_no_prediction_of_its_old_length(capture: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    run = TrainingRun.create(capture, folder, micro_config(iterations=10))
    prediction = Prediction(cpu_s=60.0, minutes=1.0, threads=1, gaussians=100)
    run.log.plan = run.log.plan.model_copy(update={"prediction": prediction})
    list(run)
    finished = read_plan(folder)
    assert finished is not None
    assert finished.prediction is not None
    assert finished.prediction.error is not None
    record = read_record(folder)
    for iterations, kept in ((10, True), (12, False)):
        longer = record.config.model_copy(update={"iterations": iterations})
        write_document(folder / RECORD_FILE, record.model_copy(update={"config": longer}))
        resumed = TrainingRun.resume(folder)
        assert (resumed.revision.plan.prediction is not None) == kept
        list(resumed)


def test_a_budget_that_is_used_up_does_not_count_as_nothing_to_grow(capture: Path) -> None:
    options = {**QUIET, "density.gradient_threshold": 1e-9, "density.max_anchors": 16}
    assert growth_events(micro_trainer(capture, **options)) == []


def test_a_single_time_trains_with_everything_kept(tmp_path: Path) -> None:
    """plan.mode=off on D05: deformation and residual are there, and the temporal loss has no pair."""
    folder = write_fixed(tmp_path / "c", lambda c, t: texture(16), cameras=6, times=1, size=16)
    run = TrainingRun.create(folder, tmp_path / "run", micro_config(iterations=30, **{"plan.mode": "off"}))
    assert {report.phase for report in run} == {"warmup", "joint"}
    assert load_model(tmp_path / "run").scene.deformation is not None


def test_colours_that_ignore_the_view_lose_nothing_with_those_of_another(capture: Path) -> None:
    trainer = micro_trainer(capture, **{"scene.reflection": False, "scene.residual_sh_degree": 0})
    steps(trainer, 40)
    color = trainer.scene.appearance.color[0]
    assert isinstance(color, torch.nn.Linear)
    frames, losses = trainer.capture.train[:2], []
    for weight in (0.0, 0.5):
        with torch.no_grad():
            color.weight[:, 8:] = weight  # the inputs after the feature are the direction's
        others = trainer.capture.train[2:]
        losses.append(view_dependence(trainer.scene, frames, others, trainer.images, trainer.background))
    assert losses[0] == 0.0
    assert losses[1] is not None
    assert abs(losses[1]) > 1e-3
    assert view_dependence(trainer.scene, (), frames, trainer.images, trainer.background) is None


@pytest.mark.parametrize(("loss", "decision"), [(0.05, "propose"), (0.051, "keep"), (None, "keep")])
def test_a_model_that_hardly_uses_the_view_proposes_to_train_without(
    capture: Path, tmp_path: Path, loss: float | None, decision: str
) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", micro_config(iterations=2))
    run.revision.finish(2, loss)
    plan = read_plan(tmp_path / "run")
    assert plan is not None
    found = plan.decision("view_dependence")
    assert found is not None
    assert found.decision == decision


def test_the_plan_of_a_run_is_that_of_its_statistics(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", micro_config(iterations=5))
    background = run.applied.capture.background_rgb()
    expected = make_plan(measure(run.capture, run.images, background), run.config)
    assert [d.model_dump(exclude={"saving"}) for d in run.revision.plan.decisions] == [
        d.model_dump(exclude={"saving"}) for d in expected.decisions
    ]
