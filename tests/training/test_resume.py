"""What a resumed or restarted run takes from its checkpoint, and what training leaves as it was."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import torch

from graings import kernel
from graings.raster import rasterize as rasterize_module
from graings.storage.checkpoint import load_model
from graings.storage.compact import open_model, write_compact
from graings.training.curriculum import resolution_schedule
from graings.training.curriculum.restart import RestartState
from graings.training.run import TrainingRun
from graings.training.trainer import Trainer
from tests.training.micro import micro_config, micro_trainer, steps


def advance(run: TrainingRun, until: int) -> None:
    for report in run:
        if report.iteration == until:
            break


def test_a_restarted_run_is_loaded_with_the_sampling_rate_of_its_training(
    micro: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The resolution schedule counts from the restart, not from the first iteration of the run."""
    monkeypatch.setattr(resolution_schedule, "MIN_SIDE", 4)  # the images have 16 px
    run = TrainingRun.create(micro, tmp_path / "run", micro_config(iterations=40, low_resolution_until=15_000))
    advance(run, 10)
    run._start(RestartState(10, 0.5))
    advance(run, 13)
    run.save()
    in_training = run._trainer.scene.sampling
    model = load_model(tmp_path / "run")
    write_compact(model, tmp_path / "scene.graings")
    assert run._trainer.pyramid.at(3).factor != run._trainer.pyramid.at(13).factor
    assert model.scene.sampling == open_model(tmp_path / "scene.graings").scene.sampling == in_training


def test_resuming_does_not_look_for_the_first_points_again(micro: Path, tmp_path: Path) -> None:
    """Initial points are in the checkpoint: finding them again takes up to half a minute and may find others."""
    run = TrainingRun.create(micro, tmp_path / "run", micro_config())
    assert run.images.cached_bytes > 0
    advance(run, 3)
    run.save()
    assert TrainingRun.resume(tmp_path / "run", threads=1).images.cached_bytes == 0


def test_the_time_window_comes_from_the_checkpoint(micro: Path) -> None:
    """It was chosen from the masks when the run began; another library version could choose another one."""
    trainer = micro_trainer(micro, time_window=0.3)
    steps(trainer, 2)
    config = trainer.config.model_copy(update={"time_window": None})
    resumed = Trainer.resume(trainer.capture, trainer.images, config, copy.deepcopy(trainer.scene), *trainer.state())
    assert resumed.window.first == 0.3
    assert [report.loss for report in steps(resumed, 3)] == [report.loss for report in steps(trainer, 3)]


def test_training_leaves_the_thread_counts_of_the_process_as_they_were(micro: Path, tmp_path: Path) -> None:
    before = torch.get_num_threads(), kernel.thread_count()
    try:
        torch.set_num_threads(2)
        kernel.set_threads(3)
        run = TrainingRun.create(micro, tmp_path / "run", micro_config(iterations=3, threads=1))
        assert (torch.get_num_threads(), kernel.thread_count()) == (2, 3)
        for _ in run:
            assert (torch.get_num_threads(), kernel.thread_count()) == (1, 1)
        assert (torch.get_num_threads(), kernel.thread_count()) == (2, 3)
    finally:
        torch.set_num_threads(before[0])
        kernel.set_threads(before[1])


def test_an_evaluation_during_training_draws_each_view_once(
    micro: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"evaluation.first": 3, "evaluation.factor": 100.0, "evaluation.views": 2, "guard.check_every": 1000}
    options["plan.keep"] = ["residual"]  # else the plan draws views of its own, to see whether the residual shows
    run = TrainingRun.create(micro, tmp_path / "run", micro_config(iterations=20, **options))
    drawn = 0
    draw = rasterize_module._draw

    def counted(*arguments: Any, **options: Any) -> Any:
        nonlocal drawn
        drawn += 1
        return draw(*arguments, **options)

    monkeypatch.setattr(rasterize_module, "_draw", counted)
    draws = []
    for report in run:
        draws.append(drawn)
        drawn = 0
        if report.iteration == 4:
            break
    assert draws == [1, 1, 1 + 2, 1]
