"""Runs that cannot be saved, and disks that cannot be written: what is left on disk is whole, finite and the best."""

from __future__ import annotations

import errno
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from graings.cli.training import kept_checkpoint
from graings.errors import CheckpointError, DivergedError
from graings.evaluation.evaluate import evaluate
from graings.render import render
from graings.storage import checkpoint
from graings.storage.checkpoint import best_checkpoint, load_model, newest_checkpoint
from graings.storage.run_folder import checkpoints
from graings.training.run import TrainingRun
from tests.training.micro import micro_config, spoil_loss

DIVERGES_AT = 70


def _diverged_run(micro: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, **options: object) -> TrainingRun:
    """A run that is spoiled for good from step `DIVERGES_AT` on."""
    run = TrainingRun.create(micro, folder, micro_config(**{"evaluation.checkpoint_every": 30} | options))
    spoil_loss(monkeypatch, run._trainer, lambda i: i >= DIVERGES_AT)
    with pytest.raises(DivergedError, match="The best model is kept"):
        list(run)
    return run


def _document(folder: Path) -> dict[str, Any]:
    def refuse(constant: str) -> float:
        raise AssertionError(f"{constant} is not strict JSON")

    document: dict[str, Any] = json.loads((folder / "metrics.json").read_text(), parse_constant=refuse)
    return document


def test_a_diverged_run_keeps_its_best_model_and_reports_the_reason(
    micro: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    run = _diverged_run(micro, folder, monkeypatch)
    model, document = load_model(folder), _document(folder)
    assert (document["diverged"], document["rollbacks"]) == (True, 3)
    assert "3 rollbacks: the loss was not finite" in document["diverged_reason"]
    assert document["iterations"] == model.iteration == run.iteration < DIVERGES_AT
    assert not model.finished
    assert all(bool(values.isfinite().all()) for values in model.scene.state_dict().values())
    view = model.views["val"][0]
    assert bool(render(model.scene, view.camera, view.time, model.background).color.isfinite().all())
    psnr = evaluate(model.scene, run.capture.val, run.images, model.background).psnr
    assert psnr == pytest.approx(document["splits"]["val"]["psnr"])
    assert psnr >= max(point["psnr"] for point in document["curve"]) - 1e-9
    # Whoever asks for the newest finds this one, and nothing of what came after it.
    assert max(int(one.name) for one in checkpoints(folder)) == model.iteration
    events = document["events"]
    assert [event["to_iteration"] for event in events if event["kind"] == "rolled_back"] == [50, 25, 25]
    assert events[-1]["kind"] == "diverged"
    assert sum(event["kind"] == "skipped" for event in events) >= 9


def test_the_best_evaluation_wins_over_a_worse_snapshot(
    micro: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    run = TrainingRun.create(micro, folder, micro_config(**{"guard.rollbacks": 0}))
    spoil_loss(monkeypatch, run._trainer, lambda i: i >= DIVERGES_AT)
    steps = iter(run)
    for report in steps:
        if report.iteration == 46:
            break
    assert best_checkpoint(folder) is not None
    with torch.no_grad():
        run._trainer.scene.appearance.color[-1].bias.fill_(-5.0)  # finite, and wrong
    run._trainer.optimizer.damping = 0.0
    with pytest.raises(DivergedError):
        list(steps)
    assert load_model(folder).iteration == 45
    assert _document(folder)["splits"]["val"]["psnr"] == pytest.approx(run.output.best_psnr, abs=1.0)


def test_a_run_that_diverges_before_any_evaluation_keeps_its_initial_scene(
    micro: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.training.test_diverged.DIVERGES_AT", 1)
    _diverged_run(micro, tmp_path / "run", monkeypatch)
    assert load_model(tmp_path / "run").iteration == 0
    assert _document(tmp_path / "run")["diverged"]


def test_a_diverged_run_can_be_resumed_at_its_low_rates_and_finishes(
    micro: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    _diverged_run(micro, folder, monkeypatch, iterations=90)
    monkeypatch.undo()
    again = TrainingRun.resume(folder, threads=1)
    assert again._trainer.optimizer.damping == 0.125
    assert list(again)[-1].iteration == 90
    document = _document(folder)
    assert (document["diverged"], document["rollbacks"], document["skipped_steps"]) == (False, 3, 12)
    iterations = [point["iteration"] for point in document["curve"]]
    assert iterations == sorted(set(iterations))
    assert load_model(folder).finished


def test_a_run_with_skipped_steps_resumes_bit_for_bit(
    micro: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The guard's counts and norms are part of the checkpoint."""
    config, found = micro_config(iterations=60), []
    for name, stop in (("unbroken", 60), ("broken", 32)):
        run = TrainingRun.create(micro, tmp_path / name, config)
        spoil_loss(monkeypatch, run._trainer, lambda i: i in (10, 31, 33), factor=float("inf"))
        for report in run:
            if report.iteration == stop:
                break
        if stop < 60:
            run.save()
            monkeypatch.undo()
            run = TrainingRun.resume(tmp_path / name, threads=1)
            spoil_loss(monkeypatch, run._trainer, lambda i: i in (10, 31, 33), factor=float("inf"))
            list(run)
        monkeypatch.undo()
        assert run._trainer.guard.skipped == 3
        found.append((run._trainer.guard.state(), load_model(tmp_path / name).scene.state_dict()))
    (norms, facts), scene = found[0]
    assert facts == found[1][0][1]
    assert all(torch.equal(norms[name], found[1][0][0][name]) for name in norms)
    assert all(torch.equal(scene[name], found[1][1][name]) for name in scene)


@pytest.mark.parametrize(
    ("options", "earlier", "kept"),
    [
        ({}, 5, ["00000005"]),
        ({"guard.skip_only": True}, 5, ["00000010", "00000012"]),  # such a run never rolls back
        ({}, None, ["00000010"]),  # better than none
    ],
    ids=str,
)
def test_a_diverging_scene_is_not_saved_so_that_a_resumed_run_returns_to_a_healthy_one(
    micro: Path, tmp_path: Path, options: dict[str, object], earlier: int | None, kept: list[str]
) -> None:
    folder = tmp_path / "run"
    run = TrainingRun.create(micro, folder, micro_config(**{"evaluation.checkpoint_every": 10} | options))
    for report in run:
        if report.iteration == earlier:
            run.save()
        if report.iteration == 5:
            run.trainer.guard.trend.mean = 1e3  # and falls by 2 % a step at most
            run.trainer.guard.trend._count = 1_000
        if report.iteration == 12:
            break
    assert run.save().name == kept[-1]
    assert [one.name for one in checkpoints(folder)] == kept
    where = f"iteration {int(kept[-1])}," if int(kept[-1]) < 12 else "at a checkpoint"
    assert where in kept_checkpoint(run)
    assert TrainingRun.resume(folder, threads=1).iteration == int(kept[-1])


def test_a_scene_that_is_not_finite_is_never_saved(micro: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(micro, tmp_path / "run", micro_config(**{"guard.check_every": 1000}))
    for report in run:
        if report.iteration == 30:
            break
    with torch.no_grad():
        run._trainer.scene.scaffold.features[0, 0] = float("nan")
    run.save()
    model = load_model(tmp_path / "run")
    assert model.iteration == 30
    assert all(bool(values.isfinite().all()) for values in model.scene.state_dict().values())
    event = run.log.events[-1]
    assert event.kind == "rolled_back"
    assert event.to_iteration == 25
    assert "scaffold.features was not finite" in event.reason


@pytest.mark.parametrize("file", ["scene.safetensors", "state.safetensors"])
def test_a_full_disk_in_the_middle_of_a_checkpoint_leaves_the_one_before(
    micro: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str
) -> None:
    """E21, disk full."""
    folder = tmp_path / "run"
    run = TrainingRun.create(micro, folder, micro_config(iterations=20))
    steps = iter(run)
    next(steps)
    earlier = run.save()
    contents = {path.name: path.read_bytes() for path in earlier.iterdir()}
    next(steps)
    write = checkpoint.save_file

    def full(tensors: dict[str, torch.Tensor], path: Path) -> None:
        if path.name == file:
            path.write_bytes(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")
        write(tensors, path)

    monkeypatch.setattr(checkpoint, "save_file", full)
    with pytest.raises(CheckpointError, match=r"No space left.*earlier ones are kept"):
        run.save()
    assert newest_checkpoint(folder) == earlier
    assert {path.name: path.read_bytes() for path in earlier.iterdir()} == contents
    assert sorted(path.name for path in earlier.parent.iterdir()) == [earlier.name]
    del steps
    assert TrainingRun.resume(folder, threads=1).iteration == 1


def test_a_crash_in_the_middle_of_a_checkpoint_leaves_the_one_before(
    micro: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """E21, crash: what a killed process leaves is not taken for a checkpoint, and the next save clears it away."""

    class Killed(BaseException):
        pass

    folder = tmp_path / "run"
    run = TrainingRun.create(micro, folder, micro_config(iterations=20))
    steps = iter(run)
    next(steps)
    earlier = run.save()
    next(steps)

    def killed(path: Path) -> None:
        raise Killed

    monkeypatch.setattr(checkpoint, "sync_tree", killed)
    with pytest.raises(Killed):
        run.save()
    monkeypatch.undo()
    assert newest_checkpoint(folder) == earlier
    del steps
    again = TrainingRun.resume(folder, threads=1)
    steps = iter(again)
    assert next(steps).iteration == 2
    assert load_model(again.save()).iteration == 2
