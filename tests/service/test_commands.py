"""The service as a separate process, with its worker."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from service.settings import Settings
from service.worker_child import WorkerChild

LONG_S = 60.0


@pytest.mark.slow(reason="two processes for each signal; test_end_to_end ends with SIGTERM too")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_interrupted_service_stops_its_worker(tmp_path: Path, number: signal.Signals) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "service.commands", "--with-worker", "--data", str(tmp_path), "--port", str(port)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            while readiness(port).get("workers") != 1:
                assert process.poll() is None
            (lease,) = (tmp_path / "workers").iterdir()
            worker = int(lease.stem.split("-")[-2])
            os.kill(worker, 0)  # raises if it does not run
            assert b"sqlite" not in Path(f"/proc/{worker}/cmdline").read_bytes()  # the URL may contain a password
            process.send_signal(number)
            assert process.wait(LONG_S) == 0
            with pytest.raises(ProcessLookupError):
                os.kill(worker, 0)
        finally:
            process.terminate()


@pytest.mark.parametrize(
    ("options", "word"),
    [(["--data", f"{__file__}/below"], "below"), (["--database", "foo://bar"], "foo://")],
)
def test_a_service_that_cannot_open_its_data_fails_with_one_line(tmp_path: Path, options: list[str], word: str) -> None:
    command = [sys.executable, "-m", "service.commands", "--port", "0", "--data", str(tmp_path), *options]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=LONG_S, check=False)
    assert ended.returncode == 1
    (line,) = ended.stderr.splitlines()
    assert word in line
    assert "--data" in line


def test_a_worker_that_refuses_its_arguments_is_not_restarted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with WorkerChild(Settings(data=tmp_path), threads=1_000) as child:
        child._supervisor.join(LONG_S)
        assert not child._supervisor.is_alive()
    assert caplog.text.count("refuses") == 1


def readiness(port: int) -> dict[str, Any]:
    """The response of /readyz; empty while the service does not listen yet."""
    time.sleep(0.1)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=10) as response:
            document: dict[str, Any] = json.load(response)
            return document
    except urllib.error.URLError:
        return {}
