from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from jobs.exit_code import ExitCode
from jobs.job import JobSpec
from jobs.store import JobFolder, Store


def job(store: Store) -> JobFolder:
    unpacked = write_synthetic(store.uploads / "u", frames=6, size=24)
    config = make_config("draft", {"iterations": 100_000, "init.points": 300}).model_dump(mode="json")
    return store.folder(store.create(JobSpec(name="job", capture="0" * 64, config=config), unpacked))


def trainer(folder: JobFolder) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "jobs.trainer_process", str(folder.path), "--threads", "1"]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)


def test_a_damaged_capture_is_refused_with_a_message_and_its_own_exit_code(tmp_path: Path) -> None:
    store = Store(tmp_path)
    folder = job(store)
    next((store.capture("0" * 64) / "train").glob("*.png")).unlink()
    with trainer(folder) as process:
        assert process.stdout is not None
        said = process.stdout.read()  # its standard input stays open: closing that would tell it to stop
        assert process.wait(60) == ExitCode.REFUSED
    assert "train/r_" in json.loads(said)["error"]
    assert folder.checkpoint() is None
