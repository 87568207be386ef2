"""Whole runs on a tiny capture: learn, resume, freeze, leave out."""

from __future__ import annotations

import json
import resource
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from graings.capture.capture import Capture
from graings.capture.load import load_capture
from graings.capture.synthetic import write_synthetic
from graings.config import TrainConfig, make_config
from graings.errors import CaptureError, CheckpointError, ConfigError
from graings.evaluation.metrics import SplitMetrics
from graings.raster.photometric import photometric
from graings.render import low_pass
from graings.report import evaluate_run as evaluate_module
from graings.report.evaluate_run import evaluate_run
from graings.report.events import Stiff
from graings.report.machine import version_facts
from graings.report.metrics_document import read_metrics
from graings.report.run_record import read_record
from graings.storage.checkpoint import load_model, newest_checkpoint
from graings.storage.compact import open_model
from graings.storage.run_folder import LOCK_FILE
from graings.training import run as run_module
from graings.training import run_output, training_log
from graings.training.guard.stiffness import Stiffness
from graings.training.held_out import HeldOut
from graings.training.run import TrainingRun
from tests.capture.captures import entry, orbit, pixels, write_image

ITERATIONS = 60

# The top level that readers of `metrics.json` rely on.
KEYS = (
    *("schema", "splits", "train_s", "total_s", "iterations", "gaussians", "anchors", "bytes", "render_fps"),
    *("curve", "machine", "versions", "seed", "hashes"),
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic(tmp_path_factory.mktemp("capture") / "tiny", seed=1, frames=12, size=32, bodies=2)


def _config(**overrides: object) -> TrainConfig:
    # Growth, pruning, warm-up, evaluation and a checkpoint all fall inside these few iterations.
    small = {
        "iterations": ITERATIONS,
        "threads": 1,
        "warmup": 10_000,
        "init.points": 800,
        "scene.children": 4,
        "scene.residual_sh_degree": 2,  # as all presets but draft have it
        "density.statistics_from": 500,
        "density.grow_from": 4_000,
        "density.grow_every": 8,
        "density.min_observations": 2,
        "density.prune_from": 22_000,
        "density.prune_min_views": 2,
        "density.prune_opacity": 0.05,
        "evaluation.first": 10,
        "evaluation.checkpoint_every": 37,
    }
    return make_config("draft", small | overrides)


@pytest.fixture(scope="module")
def unbroken(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of `_config()` with one thread; tests that change it take a copy."""
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    list(TrainingRun.create(capture, folder, _config()))
    return folder


def _tensors(run: Path) -> dict[str, torch.Tensor]:
    return load_model(run).scene.state_dict()


def test_training_lowers_the_held_out_error_and_writes_everything(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", _config(iterations=200))
    reports = list(run)
    assert [report.iteration for report in reports] == list(range(1, 201))
    assert {report.phase for report in reports} == {"warmup", "joint"}
    points = [report.evaluation for report in reports if report.evaluation is not None]
    assert points[-1].psnr > points[0].psnr + 3
    document = json.loads((tmp_path / "run" / "metrics.json").read_text(), parse_constant=_refuse)
    for key in KEYS:
        assert key in document, key
    assert list(document["splits"]) == ["val"]
    assert document["splits"]["val"]["lpips_vgg"] is not None or document["splits"]["val"]["lpips_reason"]
    assert len(document["curve"]) == len(points)
    assert (tmp_path / "run" / "curve.svg").read_text().lstrip().startswith(("<svg", "<?xml"))
    assert load_model(tmp_path / "run").finished


def test_the_commit_is_that_of_the_code_that_trained(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long run ends long after it began, and its checkout may have moved on."""
    commits, facts = iter(["first", "second", "third"]), version_facts()
    monkeypatch.setattr(
        "graings.training.training_log.version_facts", lambda: facts.model_copy(update={"commit": next(commits)})
    )
    list(TrainingRun.create(capture, tmp_path / "run", _config()))
    documents = [json.loads((tmp_path / "run" / name).read_text()) for name in ("run.json", "metrics.json")]
    assert [document["versions"]["commit"] for document in documents] == ["first"] * 2


class _Clock:
    """Time in which every look at it costs 0.1 ms, and what is slowed half a second: the same on every machine."""

    def __init__(self) -> None:
        self.now = 0.0
        self.slowed: set[str] = set()

    def look(self) -> float:
        self.now += 1e-4
        return self.now

    def slowed_down(self, function: Callable[..., Any], name: str) -> Callable[..., Any]:
        def slow(*arguments: Any, **named: Any) -> Any:
            self.now += 0.5
            self.slowed.add(name)
            return function(*arguments, **named)

        return slow


def _slow_clock(monkeypatch: pytest.MonkeyPatch) -> _Clock:
    """Replace the time; evaluations, loading, checkpoints and reports are slow in it."""
    clock = _Clock()
    monkeypatch.setattr(time, "perf_counter", clock.look)
    for module, name in (
        (run_module, "load_capture"),
        (run_output, "save_checkpoint"),
        (training_log, "report_training"),
    ):
        monkeypatch.setattr(module, name, clock.slowed_down(getattr(module, name), name))
    monkeypatch.setattr(HeldOut, "measure", clock.slowed_down(HeldOut.measure, "HeldOut.measure"))
    return clock


def test_a_slow_evaluation_costs_total_time_and_no_training_time(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = _slow_clock(monkeypatch)
    list(TrainingRun.create(capture, tmp_path / "run", _config(iterations=20)))
    assert clock.slowed == {"HeldOut.measure", "load_capture", "save_checkpoint", "report_training"}
    document = json.loads((tmp_path / "run" / "metrics.json").read_text())
    slept = 0.5 * len(document["curve"])
    assert document["phases_s"]["evaluation"] >= slept
    assert document["train_s"] <= document["wall_s"] - slept
    # Nobody loses a second: the clock on the wall and the phases tell the same.
    assert document["total_s"] == pytest.approx(document["wall_s"], abs=0.05)
    report = json.loads((tmp_path / "run" / "report" / "work_precision.json").read_text(), parse_constant=_refuse)
    (part,) = report["training"]
    assert part["run"]["status"] == "finished"
    assert len(part["points"]) == len(document["curve"])
    assert (tmp_path / "run" / "report" / "training.svg").exists()


def test_a_halted_machine_costs_training_time_and_no_processor_time(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept = 0.0

    def slowly(*arguments: Any, **options: Any) -> torch.Tensor:
        nonlocal slept
        slept += 0.1
        time.sleep(0.1)
        return photometric(*arguments, **options)

    monkeypatch.setattr("graings.training.objective.photometric", slowly)
    list(TrainingRun.create(capture, tmp_path / "run", _config(iterations=10, threads=1)))
    document = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert document["train_s"] >= slept
    assert 0 < document["train_cpu_s"] <= document["train_s"] - 0.9 * slept
    points = document["curve"]
    assert [point["train_cpu_s"] for point in points] == sorted(point["train_cpu_s"] for point in points)
    assert points[-1]["train_cpu_s"] <= document["train_cpu_s"]


def _refuse(constant: str) -> float:
    raise AssertionError(f"{constant} is not strict JSON")


def test_two_processes_do_not_train_in_one_folder(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", _config())
    training = iter(run)
    next(training)
    with pytest.raises(CheckpointError, match="being trained by another process"):
        next(iter(TrainingRun.resume(tmp_path / "run")))
    del training
    run.save()
    assert next(iter(TrainingRun.resume(tmp_path / "run"))).iteration == 2


def test_any_number_of_threads_trains_the_same_model(capture: Path, unbroken: Path, tmp_path: Path) -> None:
    list(TrainingRun.create(capture, tmp_path / "run", _config(threads=3)))
    one, many = _tensors(unbroken), _tensors(tmp_path / "run")
    assert all(torch.equal(one[name], many[name]) for name in one)


@pytest.mark.parametrize(
    "stop",
    [
        pytest.param(5, marks=pytest.mark.slow(reason="60 steps more; 23 and 41 are before and after growth")),
        23,
        41,
        pytest.param(53, marks=pytest.mark.slow(reason="60 steps more; 23 and 41 are before and after growth")),
    ],
)
def test_a_run_resumed_from_any_checkpoint_equals_the_unbroken_run_bit_for_bit(
    capture: Path, unbroken: Path, tmp_path: Path, stop: int
) -> None:
    assert {"grew", "pruned"} <= {event.kind for event in read_metrics(unbroken / "metrics.json").events}
    broken = TrainingRun.create(capture, tmp_path / "run", _config())
    for report in broken:
        if report.iteration == stop:
            break
    broken.save()
    list(TrainingRun.resume(tmp_path / "run", threads=1))
    expected, resumed = _tensors(unbroken), _tensors(tmp_path / "run")
    assert resumed.keys() == expected.keys()
    for name, tensor in expected.items():
        assert torch.equal(resumed[name], tensor), name


def test_resuming_without_a_checkpoint_starts_over(capture: Path, tmp_path: Path) -> None:
    TrainingRun.create(capture, tmp_path / "run", _config())
    assert TrainingRun.resume(tmp_path / "run", threads=1).iteration == 0


def test_a_run_that_cannot_start_leaves_no_record_so_that_the_mended_capture_can_be_trained(tmp_path: Path) -> None:
    folder = tmp_path / "capture"
    write_synthetic(folder, seed=1, frames=4, size=32, bodies=1)
    whole = {path: path.read_bytes() for path in folder.rglob("*.png")}
    for path in whole:
        write_image(path, np.zeros((32, 32, 4)))
    with pytest.raises(CaptureError, match="every mask is empty"):
        TrainingRun.create(folder, tmp_path / "run", _config())
    for path, image in whole.items():
        path.write_bytes(image)
    assert TrainingRun.create(folder, tmp_path / "run", _config()).iteration == 0


def test_a_resumed_run_keeps_its_options(capture: Path, tmp_path: Path) -> None:
    config = _config(**{"batch": 3, "loss.rigidity": 0.01, "density.max_anchors": 123, "matrix_optimizer": "adam"})
    TrainingRun.create(capture, tmp_path / "run", config)
    assert TrainingRun.resume(tmp_path / "run").config == config


def test_a_run_cut_off_before_its_metrics_ends_as_the_unbroken_one_when_resumed(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Stiffness, "events", lambda _, iteration: (Stiff(iteration=iteration, step_over_size=2.0),))
    *_, reported = TrainingRun.create(capture, tmp_path / "run", _config(iterations=20))
    metrics = tmp_path / "run" / "metrics.json"
    expected = json.loads(metrics.read_text())
    metrics.unlink()
    (again,) = TrainingRun.resume(tmp_path / "run", threads=1)
    found = json.loads(metrics.read_text())
    assert found["splits"]["val"] == expected["splits"]["val"]
    assert (found["gaussians"], found["iterations"]) == (expected["gaussians"], 20)
    assert [point["psnr"] for point in found["curve"]] == [point["psnr"] for point in expected["curve"]]
    assert found["events"] == expected["events"]
    assert "stiff" in {event.kind for event in again.events}
    for report in (again, reported):
        assert (report.iteration, report.iterations, report.phase) == (20, 20, "joint")
        assert (report.gaussians, report.anchors) == (expected["gaussians"], expected["anchors"])
    assert set(again.events) == set(reported.events)
    assert again.evaluation is not None
    assert reported.evaluation is not None
    assert again.evaluation.psnr == reported.evaluation.psnr


def test_a_complete_run_that_is_resumed_reports_its_end_and_changes_nothing(unbroken: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(unbroken, folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    (report,) = TrainingRun.resume(folder, threads=1)
    assert (report.iteration, report.iterations, report.events) == (ITERATIONS, ITERATIONS, ())
    assert report.evaluation == read_metrics(folder / "metrics.json").curve[-1]
    after = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert {path: content for path, content in after.items() if path.name != LOCK_FILE} == {
        path: content for path, content in before.items() if path.name != LOCK_FILE
    }


def test_only_the_last_two_checkpoints_and_the_best_are_kept(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", _config(**{"evaluation.checkpoint_every": 10}))
    list(run)
    assert sorted(p.name for p in (tmp_path / "run" / "checkpoints").iterdir()) == ["00000050", "00000060", "best"]


def test_best_is_the_best_point_of_the_curve_also_when_that_is_the_last(unbroken: Path) -> None:
    curve = read_metrics(unbroken / "metrics.json").curve
    best = load_model(unbroken / "checkpoints" / "best")
    assert best.iteration == max(curve, key=lambda point: point.psnr).iteration == ITERATIONS
    for name, tensor in load_model(unbroken).scene.state_dict().items():
        assert torch.equal(tensor, best.scene.state_dict()[name]), name


def test_warmup_leaves_temporal_modules_untouched_and_the_joint_phase_moves_them(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", _config())
    trainer = run._trainer
    temporal = {
        name: parameter.detach().clone()
        for name, parameter in trainer.scene.named_parameters()
        if name.startswith(("deformation", "residual"))
    }
    assert temporal
    still = dict(trainer.scene.named_parameters())
    for report in run:
        if report.phase == "warmup":
            for name, before in temporal.items():
                assert torch.equal(still[name], before), name
                assert still[name] not in trainer.optimizer.adam.state
    assert any(not torch.equal(still[name], before) for name, before in temporal.items())


def test_a_folder_with_a_run_is_not_overwritten(capture: Path, tmp_path: Path) -> None:
    TrainingRun.create(capture, tmp_path / "run", _config())
    with pytest.raises(CheckpointError, match="already holds a run"):
        TrainingRun.create(capture, tmp_path / "run", _config())


def test_of_two_runs_begun_at_once_in_one_folder_the_second_leaves_the_first_as_it_is(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"

    def load_while_another_begins(*arguments: Any) -> Capture:
        loaded = load_capture(*arguments)
        if not (folder / "run.json").exists():
            monkeypatch.undo()
            TrainingRun.create(capture, folder, _config(seed=1))
        return loaded

    monkeypatch.setattr("graings.training.run.load_capture", load_while_another_begins)
    with pytest.raises(CheckpointError, match="already holds a run"):
        TrainingRun.create(capture, folder, _config(seed=2))
    assert read_record(folder).config.seed == 1
    assert next(iter(TrainingRun.resume(folder))).iteration == 1


def test_another_capture_is_refused_on_resume(capture: Path, tmp_path: Path) -> None:
    TrainingRun.create(capture, tmp_path / "run", _config())
    other = write_synthetic(tmp_path / "other", seed=2, frames=12, size=32, bodies=2)
    with pytest.raises(CheckpointError, match="not the capture"):
        TrainingRun.resume(tmp_path / "run", capture=other)


def test_a_damaged_checkpoint_is_named(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", _config())
    next(iter(run))
    run.save()
    newest = newest_checkpoint(tmp_path / "run")
    (newest / "scene.safetensors").write_bytes(b"not a tensor file")
    with pytest.raises(CheckpointError, match="damaged checkpoint"):
        load_model(tmp_path / "run")


@pytest.mark.parametrize("too_large", ["scene.safetensors", "state.safetensors"])
def test_a_disk_too_full_keeps_the_checkpoint_before_and_says_what_to_do(
    capture: Path, tmp_path: Path, too_large: str
) -> None:
    folder = tmp_path / "run"
    run = TrainingRun.create(capture, folder, _config())
    steps = iter(run)
    next(steps)
    run.save()
    before = newest_checkpoint(folder)
    assert before is not None
    sizes = {file.name: file.stat().st_size for file in before.iterdir()}
    assert sizes["scene.safetensors"] < sizes["state.safetensors"]  # which is written second
    room = sizes[too_large] - 1_000
    next(steps)
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limit[1]))
    try:
        with pytest.raises(CheckpointError, match=r"00000002: cannot write the checkpoint .* Free some space"):
            run.save()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert [one.name for one in (folder / "checkpoints").iterdir()] == [before.name]
    assert load_model(folder).iteration == 1
    run.save()  # there is room again
    assert load_model(folder).iteration == 2


@pytest.mark.parametrize("file", ["scene.safetensors", "state.safetensors", "checkpoint.json"])
def test_a_damaged_newest_checkpoint_falls_back_to_the_one_before(
    unbroken: Path, tmp_path: Path, file: str, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(unbroken, folder)
    older, newest = sorted(one for one in (folder / "checkpoints").iterdir() if one.name.isdigit())
    (newest / file).write_bytes((newest / file).read_bytes()[:100])
    resumed = TrainingRun.resume(folder, threads=1)
    assert resumed.iteration == int(older.name)
    assert str(newest / file if file == "checkpoint.json" else newest) in caplog.text
    assert "damaged" in caplog.text or "not readable" in caplog.text
    assert file == "state.safetensors" or load_model(folder).iteration == int(older.name)
    list(resumed)  # what is written at the end takes the place of the damaged one
    for name, tensor in _tensors(unbroken).items():
        assert torch.equal(tensor, _tensors(folder)[name]), name


@pytest.mark.parametrize("content", [b"", b"{}", b"not a tensor file"])
def test_a_damaged_best_checkpoint_does_not_stop_a_run(
    capture: Path, tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", _config())
    for report in run:
        if report.iteration == 40:
            break
    run.save()
    (tmp_path / "run" / "checkpoints" / "best" / "checkpoint.json").write_bytes(content)
    resumed = TrainingRun.resume(tmp_path / "run", threads=1)
    assert "best" in caplog.text
    list(resumed)
    assert load_model(tmp_path / "run" / "checkpoints" / "best").iteration > 40


@pytest.mark.parametrize("content", ["[]", "{}", '{"config": {}}', '{"config": {}, "capture": []}', "{"])
def test_a_damaged_record_is_named_by_all_who_read_it(capture: Path, tmp_path: Path, content: str) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", _config())
    next(iter(run))
    run.save()
    (tmp_path / "run" / "run.json").write_text(content)
    with pytest.raises(CheckpointError, match=r"run\.json.*(anew|again)"):
        TrainingRun.resume(tmp_path / "run")
    with pytest.raises(CheckpointError, match=r"run\.json.*(anew|again)"):
        evaluate_run(tmp_path / "run", "val")


def test_a_training_state_that_lacks_something_is_named(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", _config())
    next(iter(run))
    file = run.save() / "checkpoint.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"state": {}}))
    with pytest.raises(CheckpointError, match=rf"{file.parent.name}.*lacks 'restart': another version wrote it"):
        TrainingRun.resume(tmp_path / "run")


def test_metrics_without_splits_are_named(capture: Path, tmp_path: Path) -> None:
    list(TrainingRun.create(capture, tmp_path / "run", _config(iterations=2)))
    (tmp_path / "run" / "metrics.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"metrics\.json.*splits.*--resume"):
        evaluate_run(tmp_path / "run", "val")


def test_a_background_of_opaque_images_is_refused(tmp_path: Path) -> None:
    """The photographs keep theirs, and no number of such views means anything."""
    for index in range(4):
        write_image(tmp_path / f"scene/images/{index}.png", pixels(12, 12, 3, seed=index))
    frames = [entry(orbit(index, 4), f"images/{index}.png", index / 3) for index in range(4)]
    (tmp_path / "scene/transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    list(TrainingRun.create(tmp_path / "scene", tmp_path / "run", _config(iterations=2)))
    with pytest.raises(ConfigError, match="without alpha"):
        evaluate_run(tmp_path / "run", "val", background=(0.0, 0.0, 0.0))


def test_a_split_that_was_added_during_an_evaluation_is_kept(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    list(TrainingRun.create(capture, tmp_path / "run", _config(iterations=2)))
    measure = evaluate_module.evaluate
    began: list[str] = []

    def evaluate(*arguments: Any, **more: Any) -> SplitMetrics:
        if not began:
            began.append("test")
            evaluate_run(tmp_path / "run", "test")
        return measure(*arguments, **more)

    monkeypatch.setattr(evaluate_module, "evaluate", evaluate)
    evaluate_run(tmp_path / "run", "val")
    assert set(read_metrics(tmp_path / "run" / "metrics.json").splits) == {"val", "test"}


def test_test_split_is_measured_only_when_asked(capture: Path, tmp_path: Path) -> None:
    list(TrainingRun.create(capture, tmp_path / "run", _config()))
    metrics = evaluate_run(tmp_path / "run", "test")
    document = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert document["splits"]["test"]["psnr"] == metrics.psnr
    assert set(document["splits"]) == {"val", "test"}


def test_a_single_time_drops_the_deformation_and_the_plan_says_so(capture: Path, tmp_path: Path) -> None:
    still = tmp_path / "still"
    still.mkdir()
    for name in ("train", "val", "test"):
        facts = json.loads((capture / f"transforms_{name}.json").read_text())
        for frame in facts["frames"]:
            del frame["time"]
        (still / f"transforms_{name}.json").write_text(json.dumps(facts))
        (still / name).mkdir()
        for image in (capture / name).iterdir():
            (still / name / image.name).write_bytes(image.read_bytes())
    run = TrainingRun.create(still, tmp_path / "run", _config(iterations=20))
    assert {report.phase for report in run} == {"static"}
    assert load_model(tmp_path / "run").scene.deformation is None
    decisions = json.loads((tmp_path / "run" / "metrics.json").read_text())["plan"]["decisions"]
    dropped = {d["component"]: d["reason"] for d in decisions if d["decision"] == "drop"}
    assert "1 distinct training time" in dropped["deformation"]
    assert {"deformation", "residual", "temporal_loss", "rigidity"} <= set(dropped)


@pytest.mark.parametrize(
    "ablation",
    [
        {"scene.stop_gradient": False},
        {"loss.temporal": 0.0},
        {"loss.deformation": 0.0},
        {"loss.residual": 0.0},
        {"loss.rigidity": 0.0},
        {"scene.single_mlp": True},
        {"scene.residual": False},
        {"scene.canonical": False},
        {"scene.deformation": "anchor"},
        {"scene.time_conditioning": "concatenated"},
        {"scene.time_conditioning": "concatenated", "scene.single_mlp": True},
    ],
)
def test_every_ablation_of_the_paper_trains_and_renders(
    capture: Path, tmp_path: Path, ablation: dict[str, object]
) -> None:
    reports = list(TrainingRun.create(capture, tmp_path / "run", _config(iterations=30, **ablation)))
    assert reports[-1].evaluation is not None
    assert reports[-1].evaluation.psnr > 8


def test_unknown_options_are_named_and_not_reported_as_damage(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", _config(iterations=2))
    list(run)
    for path in (tmp_path / "run" / "run.json", *(tmp_path / "run").glob("checkpoints/*/checkpoint.json")):
        facts = json.loads(path.read_text())
        facts["config"]["scene"]["gone_since"] = 8
        path.write_text(json.dumps(facts))
    for read in (TrainingRun.resume, load_model):
        with pytest.raises(CheckpointError, match=r"scene\.gone_since.*Use the version that wrote it"):
            read(tmp_path / "run")


def test_a_model_stores_the_sampling_rate_of_its_low_pass(capture: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(capture, tmp_path / "run", _config(iterations=12))
    list(run)
    cameras = [frame.camera for frame in run.capture.train]
    for path in (tmp_path / "run", tmp_path / "run" / "model.graings"):
        scene = open_model(path).scene
        assert scene.sampling == run._trainer.scene.sampling
        for camera in cameras:
            assert low_pass(scene.compose(camera.center, 0.5), camera) == scene.config.blur
