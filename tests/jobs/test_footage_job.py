from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from graings.config import make_config
from graings.footage.make_capture import TRANSFORMS, WORKSPACE
from jobs.exit_code import ExitCode
from jobs.job import JobSpec
from jobs.progress import last_progress, read_progress
from jobs.store import JobFolder, Store
from tests.footage.clips import encode, film

pytest.importorskip("av")
pytest.importorskip("pycolmap")


def job(store: Store, images: list[np.ndarray]) -> JobFolder:
    upload = store.uploads / "u"
    upload.mkdir()
    encode(upload / "video.mp4", images)
    config = make_config("draft", {"iterations": 12, "init.max_points": 300}).model_dump(mode="json")
    return store.folder(store.create(JobSpec(name="job", capture="0" * 64, config=config), upload))


def trainer(folder: JobFolder) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "jobs.trainer_process", str(folder.path), "--threads", "1"]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)


def test_a_video_whose_frames_do_not_fit_together_fails_with_the_reason_and_the_remedy(tmp_path: Path) -> None:
    noise = [np.random.default_rng(seed).integers(0, 256, (64, 64, 3), dtype=np.uint8) for seed in range(10)]
    folder = job(Store(tmp_path), noise)
    with trainer(folder) as process:
        assert process.stdout is not None
        output = process.stdout.read()
        assert process.wait(120) == ExitCode.REFUSED
    message = json.loads(output)["error"]
    assert message.startswith("video.mp4: ")  # and nothing of the folders of the service
    assert str(tmp_path) not in message
    assert "could be registered" in message
    report = last_progress(folder.progress)
    assert report is not None
    assert report.phase == "capture"


@pytest.mark.slow("a scene is drawn 24 times at 320 px, its cameras are found, and it is trained")
def test_a_job_on_a_video_stops_while_its_cameras_are_found_continues_there_and_trains(tmp_path: Path) -> None:
    folder = job(Store(tmp_path), film("room", 24, 320)[0])
    with trainer(folder) as process:
        while (report := last_progress(folder.progress)) is None or report.step != "features":
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        assert process.wait(120) == ExitCode.STOPPED
    frames = folder.capture / WORKSPACE / "frames"
    written = {path: path.stat().st_mtime_ns for path in frames.iterdir()}
    assert len(written) == 24
    assert folder.checkpoint() is None

    with trainer(folder) as process:
        assert process.wait(300) == ExitCode.DONE
    reports = [report for _, report in read_progress(folder.progress, 0)[0]]
    assert list(dict.fromkeys(report.phase for report in reports))[:2] == ["capture", "loading"]
    steps = [report.step for report in reports if report.phase == "capture"]
    assert steps.count("frames") <= 24  # the frames were not extracted again
    assert {"features", "matching", "mapping", "undistortion"} <= set(steps)
    assert (folder.capture / TRANSFORMS).exists()
    assert json.loads(folder.metrics.read_text())["capture"]["frames"]["train"] > 10
