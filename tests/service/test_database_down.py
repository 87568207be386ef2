"""While PostgreSQL is stopped, requests that need it fail at once, and all others are answered."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from starlette.testclient import TestClient

from service.settings import Settings
from tests.jobs.test_postgres import Server, serving
from tests.service.test_jobs import problem

pytestmark = pytest.mark.slow(reason="starts a PostgreSQL server")

REQUESTS = 60  # more than the service has threads


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as server:
        yield server


@pytest.fixture
def settings(settings: Settings, server: Server) -> Settings:
    return settings.model_copy(update={"database": server.url})


def test_the_service_is_ready_again_after_a_restart_of_the_database(client: TestClient, server: Server) -> None:
    assert client.get("/readyz").status_code == 200
    with server.stopped():
        answer = client.get("/readyz")
        assert "does not answer" in problem(answer, 503)["detail"]
        assert answer.headers["retry-after"] == "5"
        assert str(server.port) not in answer.text
    assert client.get("/readyz").json()["ready"]


def test_requests_that_need_the_database_do_not_delay_others(client: TestClient, server: Server) -> None:
    assert client.get("/jobs").json()["jobs"] == []
    with ThreadPoolExecutor(REQUESTS) as pool, server.stopped():
        answers = [pool.submit(client.get, f"/jobs/{number:016x}") for number in range(REQUESTS)]
        assert pool.submit(client.get, "/options").result(20).status_code == 200
        assert {answer.result(20).status_code for answer in answers} == {503}
    assert client.get(f"/jobs/{0:016x}").status_code == 404
