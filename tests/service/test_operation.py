"""What an operator sees and does: metrics, logs, `doctor`, and stopping a service with open event streams."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient
from typer.testing import CliRunner

from client import Client, Event
from graings.cli.main import app as commands
from jobs.progress import ProgressReport, ProgressWriter
from jobs.store import JobFolder
from service.commands import GRACEFUL_S
from tests.service.test_contract import running


def numbers(client: TestClient) -> dict[str, float]:
    """Samples without labels by name, and the count of requests by route and status."""
    answer = client.get("/metrics")
    assert answer.status_code == 200
    found = {}
    for family in text_string_to_metric_families(answer.text):
        for sample in family.samples:
            if not sample.labels:
                found[sample.name] = sample.value
            elif sample.name.endswith("_count"):
                labels = sample.labels
                found[f"{labels['method']} {labels['route']} {labels['status']}"] = sample.value
    return found


def test_the_metrics_count_requests_by_route_and_jobs_by_state(client: TestClient, job: str) -> None:
    for path in (f"/jobs/{job}", f"/jobs/{job}", "/nowhere", "/render?job=x"):
        client.get(path)
    found = numbers(client)
    assert found["GET /jobs/{job_id} 200"] == 2
    assert found["GET none 404"] == 1
    assert (found["graings_jobs_waiting"], found["graings_jobs_running"], found["graings_workers"]) == (1, 0, 0)
    assert found["graings_free_bytes"] > 0
    assert job not in client.get("/metrics").text
    assert numbers(client)["GET /metrics 200"] == 2


def test_every_answer_has_an_id_that_the_log_has_too(
    client: TestClient, job: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO", "service.requests"):
        ids = {client.get(path).headers["x-request-id"] for path in (f"/jobs/{job}", "/nowhere")}
    assert len(ids) == 2
    logged = [vars(record) for record in caplog.records if record.name == "service.requests"]
    assert {record["request"] for record in logged} == ids
    assert [(record["job"], record["status"]) for record in logged] == [(job, 200), (None, 404)]


def test_logs_are_json_where_that_is_asked_for(tmp_path: Path) -> None:
    code = (
        "import logging; from jobs.logs import log_to_stderr; log_to_stderr();"
        "logging.getLogger('jobs').info('hello', extra={'job': 'a'});"
        "logging.getLogger('service.requests').info('GET /')"
    )

    def lines(**environment: str) -> list[str]:
        ended = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, **environment}, check=True
        )
        return ended.stderr.splitlines()

    first, second = map(json.loads, lines(GRAINGS_LOG="json"))
    assert (first["message"], first["name"], first["levelname"], first["job"]) == ("hello", "jobs", "INFO", "a")
    assert second["message"] == "GET /"
    (line,) = lines(GRAINGS_LOG="")
    assert re.fullmatch(r"[-\d]+ [:\d,]+ jobs: hello", line)


def test_the_doctor_looks_at_the_machine_and_the_service(tmp_path: Path) -> None:
    ended = CliRunner().invoke(commands, ["doctor", "--data", str(tmp_path / "data")])
    for check in ("kernel", "disk", "database", "port", "pycolmap", "LPIPS", "python"):
        assert check in ended.output
    assert ended.exit_code == 0
    (tmp_path / "file").write_text("")
    broken = CliRunner().invoke(commands, ["doctor", "--data", str(tmp_path / "file" / "data")])
    assert broken.exit_code == 1
    assert "broken" in broken.output


def test_a_service_stops_with_open_streams_and_their_clients_come_back(tmp_path: Path, capture: Path) -> None:
    data, seen = tmp_path / "data", list[Event]()
    with running(data) as (url, process), Client(url) as client:
        job = client.submit(capture, preset="draft").id
        thread = threading.Thread(target=client.wait, args=(job, seen.append))
        thread.start()
        while not seen:
            time.sleep(0.05)
        began = time.monotonic()
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        assert time.monotonic() - began < 0.8 * GRACEFUL_S  # it did not wait until it may cut the stream off
        writer = ProgressWriter(JobFolder(data / "jobs" / job).progress)
        writer.write(ProgressReport(phase="joint", iteration=7, iterations=9, attempt=1))
        writer.close()
        with running(data, port=int(url.rpartition(":")[2])):
            client.cancel(job)
            thread.join(60)
    assert not thread.is_alive()
    assert [event.data["iteration"] for event in seen if event.kind == "progress"] == [7]
    assert seen[-1].kind == "end"


def test_a_method_that_a_client_makes_up_is_counted_with_the_others_of_its_kind(client: TestClient) -> None:
    """Each would be a histogram that stays in memory, and nobody needs a key to send one."""
    for number in range(20):
        assert client.request(f"M{number}", "/healthz").status_code == 405
    found = numbers(client)
    assert sum(count for name, count in found.items() if name.startswith("other ")) == 20
    assert not any(name.startswith("M") for name in found)


def test_head_is_counted_and_logged_as_its_route(
    client: TestClient, job: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO", "service.requests"):
        assert client.head(f"/jobs/{job}").status_code == 200
    assert [vars(record)["job"] for record in caplog.records if record.name == "service.requests"] == [job]
    assert numbers(client)["HEAD /jobs/{job_id} 200"] == 1
