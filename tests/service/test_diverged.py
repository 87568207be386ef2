"""A job that diverges, from the upload to the rendered image, with a real worker."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.settings import Settings

# The learning rate grows without bound: the first steps are finite, those a few dozen later are not.
BLOW_UP = {
    "iterations": 200,
    "init.points": 200,
    "evaluation.first": 2,
    "rates.deformation": [0.005, 1e30],
    "guard.patience": 5,
}
LONG_S = 120.0


def _refuse(constant: str) -> float:
    raise AssertionError(f"{constant} is not strict JSON")


@pytest.mark.slow(reason="a worker and a training that goes back three times")
def test_a_job_that_diverges_has_this_state_and_its_best_model_can_be_rendered(
    client: TestClient, archive: bytes, settings: Settings
) -> None:
    query = {"preset": "draft", "config": json.dumps(BLOW_UP)}
    job = client.post("/jobs", params=query, content=archive).json()
    command = [sys.executable, "-m", "jobs.commands", "--data", str(settings.data), "--threads", "1"]
    with subprocess.Popen(command) as worker:
        try:
            deadline = time.monotonic() + LONG_S
            while job["state"] in ("queued", "running"):
                assert time.monotonic() < deadline, f"not ended within {LONG_S:g} s"
                time.sleep(0.2)
                job = client.get(job["links"]["self"]).json()
        finally:
            worker.terminate()
    assert job["state"] == "diverged"
    assert "after 3 rollbacks" in job["error"]
    assert (job["progress"]["phase"], job["attempts"]) == ("diverged", 1)
    assert "retry" in job["links"]
    metrics = json.loads(client.get(job["links"]["metrics"]).text, parse_constant=_refuse)
    assert metrics["diverged"]
    assert metrics["splits"]["val"]["psnr"] >= max(point["psnr"] for point in metrics["curve"]) - 1e-9
    image = client.get(job["links"]["render"], params={"camera": "val:0"})
    assert image.status_code == 200
    assert image.headers["content-type"] == "image/png"
    assert image.headers["x-graings-iteration"] == str(job["checkpoint"]) == str(metrics["iterations"])
    assert image.headers["x-graings-finished"] == "false"
    events: Any = client.get(job["links"]["events"], headers={"Last-Event-ID": "0"}).text
    assert events.count('"kind":"rolled_back"') == 3
    assert "event: end" in events
