"""A job from the upload to the image: the service, its worker and the trainer are processes of their own."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import httpx2
import pytest

from tests.service.test_commands import LONG_S, readiness

BRIEF = {"iterations": 12, "init.points": 200, "evaluation.views": 1}


def test_a_job_is_uploaded_trained_and_rendered_over_http(tmp_path: Path, archive: bytes) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "service.commands", "--with-worker", "--data", str(tmp_path), "--port", str(port)]
    deadline = time.monotonic() + 3 * LONG_S
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            while readiness(port).get("workers") != 1:
                assert process.poll() is None
                assert time.monotonic() < deadline
            (lease,) = (tmp_path / "workers").iterdir()
            worker = int(lease.stem.split("-")[-2])
            with httpx2.Client(base_url=f"http://127.0.0.1:{port}", timeout=LONG_S) as client:
                query = {"preset": "draft", "config": json.dumps(BRIEF)}
                job = client.post("/jobs", params=query, content=archive).raise_for_status().json()
                while job["state"] in ("queued", "running"):
                    assert time.monotonic() < deadline
                    time.sleep(0.1)
                    job = client.get(job["links"]["self"]).json()
                assert (job["state"], job["error"], job["checkpoint"]) == ("succeeded", None, 12)
                assert client.get(job["links"]["metrics"]).json()["iterations"] == 12
                image = client.get(job["links"]["render"], params={"camera": "val:0"})
                assert (image.status_code, image.content[:4]) == (200, b"\x89PNG")
            process.send_signal(signal.SIGTERM)
            assert process.wait(LONG_S) == 0
            with pytest.raises(ProcessLookupError):  # it took its worker along
                os.kill(worker, 0)
        finally:
            process.terminate()
