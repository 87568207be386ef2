"""The published interface: its snapshot, a fuzzer on a real server, and a generated client that trains and renders.

The tools need other versions of our libraries, so they live in an environment of their own; `scripts/contract` makes it
and puts it in front of PATH. Without them the slow tests are skipped.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from client import Client, ClientError
from service.keys import Keys, Scope
from tests.service.contract import SNAPSHOT, summary

BRIEF = {"iterations": 12, "init.points": 200, "evaluation.views": 1}
LONG_S = 120.0

# What a schema cannot say: a body that is no capture, options that are none, numbers with commas between them, a view
# of the capture, an image in no format that we have.
FUZZ = """
[[operations]]
include-operation-id = [
    "begin_upload", "submit_job", "plan_training", "inspect_capture", "render", "get_export", "get_comparison"
]
checks.positive_data_acceptance.expected-statuses = ["2xx", "3xx", 400, 401, 403, 404, 406, 409, 413, 422, 429, "5xx"]

[parameters]
job_id = "{job}"
"""


def test_the_published_interface_changes_only_on_purpose(client: TestClient) -> None:
    now = summary(client.get("/openapi.json").json())
    assert now == SNAPSHOT.read_text(), "if this is meant: python -m tests.service.contract"


@contextmanager
def running(data: Path, *options: str, port: int = 0) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A service, with its address."""
    if port == 0:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
    command = [sys.executable, "-m", "graings", "serve", "--data", str(data), "--port", str(port), *options]
    environment = {**os.environ, "GRAINGS_KEY_REQUESTS": "1000000"}
    with (
        subprocess.Popen(command, stderr=subprocess.DEVNULL, env=environment) as process,
        Client(f"http://127.0.0.1:{port}") as client,
    ):
        try:
            deadline = time.monotonic() + LONG_S
            while True:
                assert process.poll() is None
                assert time.monotonic() < deadline
                try:
                    client.readiness()
                except ClientError:
                    time.sleep(0.1)
                else:
                    break
            yield f"http://127.0.0.1:{port}", process
        finally:
            process.terminate()


def tool(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed; scripts/contract runs these tests with it")
    return found


@pytest.mark.slow(reason="a thousand requests and more to a real server")
def test_a_fuzzer_finds_nothing(tmp_path: Path, capture: Path, trained: Path) -> None:
    st = tool("st")
    data = tmp_path / "data"
    key = Keys(data / "keys").create("fuzz", Scope.ADMIN)[1]
    with running(data) as (url, _), Client(url, key=key) as client:
        job = client.submit(capture, preset="draft").id
        shutil.copytree(trained, data / "jobs" / job / "run")
        client.cancel(job)
        config = tmp_path / "schemathesis.toml"
        config.write_text(FUZZ.format(job=job))
        command = [st, "--config-file", str(config), "run", f"{url}/openapi.json", "--checks", "all"]
        command += ["-H", f"Authorization: Bearer {key}", "--request-timeout", "60", "--max-examples", "30"]
        ended = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
        print(ended.stdout[-3_000:])
        assert ended.returncode == 0, ended.stdout[-20_000:]
        client.readiness()


GENERATED = """
import json, sys, time
from graings_api.client import AuthenticatedClient
from graings_api.api.jobs import get_job, submit_job
from graings_api.api.render import render
from graings_api.models import SubmitJobFilesBody
from graings_api.types import File

url, key, archive, config, target = sys.argv[1:]
with AuthenticatedClient(base_url=url, token=key, timeout=120) as client:
    with open(archive, "rb") as file:
        body = SubmitJobFilesBody(capture=File(payload=file, file_name="capture.zip"), config=config)
        job = submit_job.sync(client=client, body=body, preset="draft", name="generated")
    while job.state in ("queued", "running"):
        time.sleep(0.2)
        job = get_job.sync(job.id, client=client)
    answer = render.sync_detailed(client=client, job=job.id, t=0.5, camera="val:0", format_="png")
    open(target, "wb").write(answer.content)
    print(job.state, job.checkpoint, answer.status_code.value)
"""


@pytest.mark.slow(reason="generates a client, and trains with it")
def test_a_generated_client_trains_and_renders(tmp_path: Path, archive: bytes) -> None:
    generator = tool("openapi-python-client")
    data, packed, image = tmp_path / "data", tmp_path / "capture.zip", tmp_path / "view.png"
    packed.write_bytes(archive)
    key = Keys(data / "keys").create("generated", Scope.TRAIN)[1]
    with running(data, "--with-worker") as (url, _):
        subprocess.run(
            [generator, "generate", "--url", f"{url}/openapi.json", "--meta", "none", "--output-path", "graings_api"],
            cwd=tmp_path, check=True, capture_output=True,
        )  # fmt: skip
        (tmp_path / "use.py").write_text(GENERATED)
        command = [
            str(Path(generator).parent / "python"),
            "use.py",
            url,
            key,
            str(packed),
            json.dumps(BRIEF),
            str(image),
        ]
        ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=3 * LONG_S, check=False)
    assert ended.stdout.split() == ["succeeded", "12", "200"], ended.stderr
    assert image.read_bytes()[:4] == b"\x89PNG"
