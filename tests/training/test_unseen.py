"""Removing what no training view shows, after the last step."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from graings.render import render
from graings.report.metrics_document import read_metrics
from graings.report.run_record import read_record
from graings.storage.compact import open_model
from graings.storage.files import write_document
from graings.storage.run_folder import RECORD_FILE
from graings.training.density.unseen import drop_unseen, largest_contributions
from graings.training.run import TrainingRun
from tests.training.micro import micro_config


def trained(capture: Path, folder: Path, **options: object) -> TrainingRun:
    run = TrainingRun.create(capture, folder, micro_config(iterations=20, **options))
    for _ in run:
        pass
    return run


def hide(run: TrainingRun, anchors: list[int]) -> None:
    """Move anchors far behind every camera."""
    with torch.no_grad():
        run.trainer.scene.scaffold.anchors[anchors] += 1_000.0


def test_anchors_that_no_training_view_shows_are_removed_and_the_views_stay_as_they_are(
    micro: Path, tmp_path: Path
) -> None:
    run = trained(micro, tmp_path / "run", **{"density.unseen_pixels": 0.0})
    scene, views = run.trainer.scene, run.capture.train
    shown = largest_contributions(scene, views)
    hidden = shown.argsort(descending=True)[[0, 3]].tolist()
    hide(run, hidden)
    assert largest_contributions(scene, views)[hidden].tolist() == [0.0, 0.0]
    uids = set(scene.scaffold.uids[hidden].tolist())
    before = [render(scene, view.camera, view.time, (1, 1, 1)).color for view in views]
    run.log.config = micro_config(iterations=20, **{"density.unseen_pixels": 1e-6})
    (event,) = drop_unseen(run.trainer, run.log)
    left = set(run.trainer.scene.scaffold.uids.tolist())
    assert not uids & left
    assert event.message == f"removed {len(shown) - len(left)} anchors that no training view shows"
    assert float(largest_contributions(run.trainer.scene, views).min()) >= 1e-6
    for view, image in zip(views, before, strict=True):
        assert float((render(run.trainer.scene, view.camera, view.time, (1, 1, 1)).color - image).abs().max()) < 1e-5
    moments = run.trainer.optimizer.adam.state  # optimiser and statistics have lost the same rows
    assert {len(moments[run.trainer.scene.scaffold.offsets]["exp_avg"])} == {len(left)}
    assert len(run.trainer.density.statistics.visits) == len(left)


def test_a_run_ends_without_them_and_says_so(micro: Path, tmp_path: Path) -> None:
    kept = trained(micro, tmp_path / "kept", **{"density.unseen_pixels": 0.0})
    run = TrainingRun.create(micro, tmp_path / "run", micro_config(iterations=20, **{"density.unseen_pixels": 0.5}))
    reports = list(run)
    assert reports[-1].anchors == run.trainer.scene.scaffold.count
    removed = kept.trainer.scene.scaffold.count - run.trainer.scene.scaffold.count
    assert removed > 0
    metrics = read_metrics(run.metrics_path)
    assert [event.anchors for event in metrics.events if event.kind == "unseen"] == [removed]
    assert not [event for event in read_metrics(kept.metrics_path).events if event.kind == "unseen"]
    assert open_model(run.folder).scene.scaffold.count == run.trainer.scene.scaffold.count
    assert metrics.curve[-1].anchors == run.trainer.scene.scaffold.count
    views = [(frame.camera.center, frame.time) for frame in run.capture.train]
    drawn = len(run.trainer.scene.compose_together(views)[0].children)
    assert 0 < metrics.gaussians == metrics.curve[-1].gaussians == reports[-1].gaussians <= drawn
    assert drawn < kept.log.gaussians


@pytest.mark.parametrize("pixels", [0.0, 0.5])
@pytest.mark.parametrize("more", [2, 40, 100])  # in which anchors do not change again, are pruned, and grow
def test_a_run_that_was_extended_trains_to_its_new_end(micro: Path, tmp_path: Path, pixels: float, more: int) -> None:
    folder = tmp_path / "run"
    config = micro_config(iterations=60, **{"density.unseen_pixels": pixels, "init.points": 400})
    for _ in (run := TrainingRun.create(micro, folder, config)):
        pass
    assert run.trainer.average.steps == (2 if pixels == 0 else 0)
    record = read_record(folder)
    longer = record.model_copy(update={"config": record.config.model_copy(update={"iterations": 60 + more})})
    write_document(folder / RECORD_FILE, longer)
    extended = TrainingRun.resume(folder)
    for step in extended:
        assert math.isfinite(step.loss)
    assert extended.iteration == 60 + more
    assert open_model(folder).scene.scaffold.count == extended.trainer.scene.scaffold.count


@pytest.mark.parametrize("pixels", [0.2, 1e9])
def test_a_scene_of_which_nothing_is_seen_stays_as_it_is(micro: Path, tmp_path: Path, pixels: float) -> None:
    run = trained(micro, tmp_path / "run", **{"density.unseen_pixels": pixels})
    if pixels < 1:
        hide(run, list(range(run.trainer.scene.scaffold.count)))
    count = run.trainer.scene.scaffold.count
    assert drop_unseen(run.trainer, run.log) == ()
    assert run.trainer.scene.scaffold.count == count
