"""A job on a synthetic scene: its trainer draws the capture first."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event

import pytest

from graings.capture.synthetic import RECIPE_FILE, SceneRecipe, find_recipe
from graings.config import make_config
from graings.errors import CaptureError
from jobs.capture_phase import Stopped, capture_of
from jobs.exit_code import ExitCode
from jobs.job import JobSpec
from jobs.progress import ProgressWriter, last_progress, read_progress
from jobs.store import JobFolder, Store

SLOW_S = 5.0  # what a busy machine may take in addition


def job(store: Store, recipe: SceneRecipe) -> JobFolder:
    upload = store.uploads / "u"
    upload.mkdir()
    (upload / RECIPE_FILE).write_text(json.dumps(recipe.to_json()))
    config = make_config("draft", {"iterations": 12, "init.points": 200}).model_dump(mode="json")
    return store.folder(store.create(JobSpec(name="job", capture="0" * 64, config=config), upload))


def trainer(folder: JobFolder) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "jobs.trainer_process", str(folder.path), "--threads", "1"]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, ExitCode.STOPPED), (signal.SIGKILL, -signal.SIGKILL)])
def test_a_job_that_ended_while_its_scene_was_drawn_draws_it_again_and_trains(
    tmp_path: Path, number: signal.Signals, status: int
) -> None:
    folder = job(Store(tmp_path), SceneRecipe(scene="still", size=32, views=100))
    with trainer(folder) as process:
        while (report := last_progress(folder.progress)) is None or not report.step_done:
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(number)
        assert process.wait(60) == status
    assert folder.checkpoint() is None
    with trainer(folder) as process:
        assert process.wait(300) == ExitCode.DONE
    reports = [report for _, report in read_progress(folder.progress, 0)[0]]
    assert list(dict.fromkeys(report.phase for report in reports))[:2] == ["capture", "loading"]
    assert {report.step for report in reports if report.phase == "capture"} == {"drawing"}
    capture_s = [report.phase_s["capture"] for report in reports]
    assert 0.0 < capture_s[0] <= capture_s[-1]
    assert capture_s == sorted(capture_s)
    metrics = json.loads(folder.metrics.read_text())
    assert metrics["capture"]["frames"]["train"] == 100
    assert (folder.capture / "trajectories.json").is_file()  # the ground truth lies beside the images


def test_the_seconds_of_the_capture_are_booked_as_such_by_all_attempts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = job(Store(tmp_path), SceneRecipe(scene="still", size=32, views=3))
    upload, stop, progress = (
        folder.path.parent.parent / "captures" / ("0" * 64),
        Event(),
        ProgressWriter(folder.progress),
    )

    def draw(_: str, target: Path, *, observe: Callable[[int, int], None], **__: object) -> None:
        target.mkdir()
        for done in (1, 2):
            time.sleep(0.1)
            observe(done, 3)
        time.sleep(0.1)

    monkeypatch.setattr("jobs.capture_phase.synthesize", draw)
    stop.set()
    phase_s = {"loading": 5.0, "capture": 10.0}  # of an attempt before
    with pytest.raises(Stopped):
        capture_of(upload, folder, 1, 12, phase_s, progress, stop)
    last = last_progress(folder.progress)
    assert last is not None
    assert last.phase_s == phase_s
    assert 10.1 <= last.phase_s["capture"] < 10.2 + SLOW_S
    stop.clear()
    before = time.monotonic()
    capture_of(upload, folder, 1, 12, phase_s, progress, stop)
    progress.close()
    assert phase_s["loading"] == 5.0
    assert last.phase_s["capture"] + 0.3 <= phase_s["capture"] <= last.phase_s["capture"] + time.monotonic() - before


def test_a_scene_that_was_drawn_is_not_drawn_again(tmp_path: Path) -> None:
    """The trainer of an extended job starts again, and the ended one is still evaluated on its capture."""
    store = Store(tmp_path)
    folder = job(store, SceneRecipe(scene="still", size=32, views=3))
    upload, stop, progress = store.capture("0" * 64), Event(), ProgressWriter(folder.progress)
    stop.set()
    with pytest.raises(Stopped):
        capture_of(upload, folder, 1, 12, {}, progress, stop)
    assert not folder.capture.exists()
    stop.clear()
    assert capture_of(upload, folder, 1, 12, {}, progress, stop) == (folder.capture, ["drew the synthetic scene still"])
    stop.set()  # so that a second drawing would end
    before = {file: file.stat().st_mtime_ns for file in folder.capture.rglob("*")}
    assert capture_of(upload, folder, 1, 12, {}, progress, stop) == (folder.capture, [])
    assert {file: file.stat().st_mtime_ns for file in folder.capture.rglob("*")} == before
    assert store.trained_on(folder.path.name) == folder.capture
    progress.close()


def test_a_recipe_is_the_only_file_of_its_folder(tmp_path: Path) -> None:
    assert find_recipe(tmp_path) is None
    (tmp_path / RECIPE_FILE).write_text('{"scene": "walker", "size": 64}')
    assert find_recipe(tmp_path) == SceneRecipe(scene="walker", size=64, views=150, seed=0)
    (tmp_path / "dataset.json").touch()  # a Nerfies folder has a scene.json too
    assert find_recipe(tmp_path) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"scene": "walkre"}', "walkre.*Choose one of walker, crossing"),
        ('{"scene": "walker", "size": 4000}', "size: Input should be less than or equal to 1024.*An example"),
        ('{"scene": "walker", "seeds": 1}', "seeds: Extra inputs"),
        ("{}", "scene: Field required"),
        ("[", "Invalid JSON"),
        ('{"scene": "walker", "seed": NaN}', "seed|JSON"),
        (b"\xff\xfe", "JSON"),
    ],
)
def test_a_recipe_that_does_not_fit_is_refused_with_an_example(tmp_path: Path, text: str | bytes, message: str) -> None:
    (tmp_path / RECIPE_FILE).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(CaptureError, match=f"{RECIPE_FILE}: .*({message})"):
        find_recipe(tmp_path)
