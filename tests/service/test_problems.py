from __future__ import annotations

import errno
import math

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from graings.errors import CaptureError, CheckpointError, ConfigError, GraingsError
from jobs.job import JobConflict, JobError, JobNotFound
from service.problems import TooLarge, install
from tests.service.test_jobs import problem


def raising(error: Exception) -> TestClient:
    """A client of an application whose only route fails."""
    app = FastAPI()
    install(app)

    @app.get("/")
    async def fail() -> None:
        raise error

    return TestClient(app)  # raises errors that no handler answers


@pytest.mark.parametrize(
    ("error", "status", "kind"),
    [
        (JobNotFound("a"), 404, "no-such-job"),
        (JobConflict("no"), 409, "state-conflict"),
        (JobError("no answer"), 503, "jobs-unavailable"),
        (ConfigError("loss.ssim: too large"), 422, "bad-config"),
        (CaptureError("broken", file="a.png", remedy="Save it again."), 422, "bad-capture"),
        (CheckpointError("damaged"), 500, "bad-checkpoint"),
        (GraingsError("other"), 500, "graings"),
        (TooLarge("large"), 413, "too-large"),
        (OSError(errno.ENOSPC, "No space left on device"), 507, "disk-full"),
    ],
)
def test_every_error_has_its_status_and_message(error: Exception, status: int, kind: str) -> None:
    document = problem(raising(error).get("/"), status)
    assert document["type"] == f"urn:graings:problem:{kind}"
    assert document["instance"] == "/"
    if status != 507:
        assert document["detail"] == str(error)


def test_a_temporary_error_has_a_retry_after() -> None:
    assert raising(JobError("no answer")).get("/").headers["retry-after"] == "5"


@pytest.mark.parametrize("error", [ZeroDivisionError("secret"), PermissionError("secret"), ValueError(math.nan)])
def test_an_unexpected_error_is_a_problem_document_without_its_message(error: Exception) -> None:
    document = problem(raising(error).get("/"), 500)
    assert document["type"] == "about:blank"
    assert "secret" not in str(document)


def test_the_frameworks_own_errors_are_problem_documents(client: TestClient) -> None:
    assert problem(client.get("/nothing/here"), 404)["instance"] == "/nothing/here"
    wrong = client.put("/jobs")
    assert problem(wrong, 405)["title"] == "Method Not Allowed"
    assert "GET" in wrong.headers["allow"] or "POST" in wrong.headers["allow"]
    problem(client.get("/web/../../etc/passwd"), 404)
    problem(client.get("/web/none.js"), 404)


def test_a_lone_surrogate_in_a_request_can_be_quoted_and_logged(
    client: TestClient, caplog: pytest.LogCaptureFixture
) -> None:
    """JSON can contain it, UTF-8 cannot."""
    document = problem(raising(GraingsError("cannot read a\ud800b")).get("/"), 500)
    assert document["detail"] == r"cannot read a\ud800b"
    assert b"cannot read a\\ud800b" in caplog.text.encode("utf-8")
    document = problem(client.post("/jobs", params={"config": '{"\\ud800": 1}'}), 422)
    assert document["type"] == "urn:graings:problem:bad-config"
