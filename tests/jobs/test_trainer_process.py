from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NoReturn

import pytest

from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from graings.storage.checkpoint import load_model
from graings.storage.locks import locked
from graings.training.run import TrainingRun
from jobs.exit_code import ExitCode
from jobs.job import JobSpec
from jobs.progress import last_progress, read_progress
from jobs.store import KEPT_ATTEMPTS, JobFolder, Store
from jobs.trainer_process import _report
from tests.jobs.test_worker import until


def job(store: Store, options: dict[str, object] | None = None) -> JobFolder:
    unpacked = write_synthetic(store.uploads / "u", frames=6, size=24)
    config = make_config("draft", {"iterations": 100_000, "init.points": 300, **(options or {})}).model_dump(
        mode="json"
    )
    return store.folder(store.create(JobSpec(name="job", capture="0" * 64, config=config), unpacked))


def trainer(folder: JobFolder) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "jobs.trainer_process", str(folder.path), "--threads", "1"]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)


def test_a_damaged_capture_is_refused_with_a_message_and_its_own_exit_code(tmp_path: Path) -> None:
    store = Store(tmp_path)
    folder = job(store)
    image = next((store.capture("0" * 64) / "train").glob("*.png"))
    image.write_bytes(image.read_bytes()[:-20])
    with trainer(folder) as process:
        assert process.stdout is not None
        output = process.stdout.read()  # its standard input stays open: closing it would stop the trainer
        assert process.wait(60) == ExitCode.REFUSED
    assert "train/r_" in json.loads(output)["error"]
    assert folder.checkpoint() is None


# A process whose clock runs a thousand times faster.
HASTY = """
import runpy, time
real = time.monotonic
time.monotonic = lambda: 1000 * real()
runpy.run_module("jobs.trainer_process", run_name="__main__")
"""


def test_a_trainer_waits_for_another_in_its_folder_however_long_and_then_trains(tmp_path: Path) -> None:
    folder = job(Store(tmp_path), {"iterations": 2})
    command = [sys.executable, "-c", HASTY, str(folder.path), "--threads", "1"]
    with locked(folder.lock), subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        status = Path(f"/proc/{process.pid}/status")
        until(lambda: int(re.findall(r"SigCgt:\t(\w+)", status.read_text())[0], 16) & 1 << signal.SIGTERM - 1)
        time.sleep(0.5)
        assert process.poll() is None
        assert last_progress(folder.progress) is None
        process.terminate()
        assert process.wait(60) == ExitCode.STOPPED
    with trainer(folder) as process:
        assert process.wait(60) == ExitCode.DONE


def test_a_finished_job_has_its_report(tmp_path: Path) -> None:
    folder = job(Store(tmp_path), {"iterations": 12})
    for _ in range(KEPT_ATTEMPTS + 2):  # of which the store keeps all but the first two
        folder.begin_attempt("worker")
    with trainer(folder) as process:
        assert process.wait(60) == ExitCode.DONE
    reports, _ = read_progress(folder.progress, 0)
    assert reports[0][1].attempt == KEPT_ATTEMPTS + 2
    document = json.loads((folder.report / "work_precision.json").read_text())
    assert document["training"][0]["run"]["name"] == folder.path.name
    assert len(document["render"][0]["points"]) > 1
    assert {"training.svg", "render.svg", "points.csv"} < {path.name for path in folder.report.iterdir()}


def test_an_error_in_the_report_is_logged_and_the_job_does_not_fail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object, **__: object) -> NoReturn:
        raise RuntimeError("no disk")

    monkeypatch.setattr("jobs.trainer_process.report_runs", broken)
    _report(job(Store(tmp_path)))
    assert "no report: RuntimeError: no disk" in capsys.readouterr().err


@pytest.mark.slow(reason="a process that goes back three times; test_diverged has the same without a process")
def test_a_training_that_diverges_ends_with_a_model_and_a_last_report(tmp_path: Path) -> None:
    store = Store(tmp_path)
    # The learning rate grows without bound: the first steps are finite, those a few dozen later are not.
    blow_up = {"iterations": 200, "evaluation.first": 2, "rates.deformation": [0.005, 1e30], "guard.patience": 5}
    folder = job(store, blow_up)
    with trainer(folder) as process:
        assert process.stdout is not None
        output = process.stdout.read()
        assert process.wait(60) == ExitCode.DIVERGED
    assert "diverged" in json.loads(output)["error"]
    model = load_model(folder.run)
    assert folder.checkpoint() == model.iteration
    assert all(bool(values.isfinite().all()) for values in model.scene.state_dict().values())
    assert json.loads(folder.metrics.read_text())["diverged"]
    last = last_progress(folder.progress)
    assert last is not None
    assert (last.phase, last.iteration) == ("diverged", model.iteration)
    assert last.phase_s["loading"] > 0.0
    reports, _ = read_progress(folder.progress, 0)
    kinds = [event.kind for _, report in reports for event in report.events]
    assert (kinds.count("rolled_back"), kinds.count("diverged"), kinds[-1]) == (3, 1, "diverged")


def test_a_job_whose_trainer_was_killed_after_its_last_step_ends_with_a_report_of_that(tmp_path: Path) -> None:
    folder = job(Store(tmp_path), {"iterations": 12})
    for killed_before_metrics in (False, True, False):
        if killed_before_metrics:
            folder.metrics.unlink()
        with trainer(folder) as process:
            assert process.wait(60) == ExitCode.DONE
        last = last_progress(folder.progress)
        assert last is not None
        assert (last.phase, last.iteration, last.iterations) == ("joint", 12, 12)
        assert last.held_out_psnr is not None
        assert last.anchors


def test_an_extended_job_goes_on_from_its_last_checkpoint(tmp_path: Path) -> None:
    begins = {"low_resolution_until": 15_000, "time_window": 0.3, "time_window_until": 30_000}
    folder = job(Store(tmp_path), {"iterations": 12, **begins})
    folder.begin_attempt("worker")
    with trainer(folder) as process:
        assert process.wait(60) == ExitCode.DONE
    folder.write_spec(folder.spec().trained_for(22))
    with trainer(folder) as process:
        assert process.wait(60) == ExitCode.DONE
    model, last = load_model(folder.run), last_progress(folder.progress)
    assert last is not None
    assert (model.iteration, model.finished, last.iteration, last.iterations) == (22, True, 22, 22)
    reports = [report for _, report in read_progress(folder.progress, 0)[0]]
    assert [report.iteration for report in reports if report.phase == "loading"] == [0, 12]
    assert last.phase_s["loading"] > reports[0].phase_s.get("loading", 0.0)
    assert set(last.phase_s) >= {"loading", last.phase}
    assert json.loads(folder.metrics.read_text())["iterations"] == 22
    trainer_ = TrainingRun.resume(folder.run)._trainer
    for iteration in (13, 22):
        assert trainer_.window.share(iteration) == 1.0
        assert trainer_.pyramid.at(iteration).factor == 1
