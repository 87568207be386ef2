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

import pytest

from client import Client, ClientError
from tests.service.test_commands import LONG_S, readiness

BRIEF = {"iterations": 12, "init.points": 200, "evaluation.views": 1}


def test_a_job_is_uploaded_trained_and_rendered_over_http(tmp_path: Path, capture: Path) -> None:
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
            with Client(f"http://127.0.0.1:{port}") as client:
                job = client.wait(client.submit(capture, preset="draft", config=BRIEF).id)
                assert (job.state, job.error, job.checkpoint) == ("succeeded", None, 12)
                metrics = client.download(job.id, "metrics", tmp_path / "metrics.json")
                assert json.loads(metrics.read_text())["iterations"] == 12
                assert client.render(job.id, camera="val:0", format="png")[:4] == b"\x89PNG"
                assert client.evaluate(job.id, "test")["splits"]["test"]["psnr"] > 5
                video = client.video(job.id, tmp_path / "video.gif", width=16, seconds=0.2, fps=20)
                assert video.read_bytes()[:6] == b"GIF89a"
                with pytest.raises(ClientError, match="frames"):
                    client.video(job.id, video, seconds=600, fps=200)
                job = client.wait(client.extend(job.id, 6).id)
                assert (job.state, job.error, job.checkpoint) == ("succeeded", None, 18)
            process.send_signal(signal.SIGTERM)
            assert process.wait(LONG_S) == 0
            with pytest.raises(ProcessLookupError):  # it took its worker along
                os.kill(worker, 0)
        finally:
            process.terminate()
