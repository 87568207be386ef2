"""Submitting a job again, longer, and finding it; HEAD and Allow."""

from __future__ import annotations

from pathlib import Path

import pytest
from starlette.testclient import TestClient

from jobs.job import JobError, JobState
from service.settings import Settings
from tests.service.conftest import queue_job
from tests.service.test_jobs import problem

KEY = {"Idempotency-Key": "a1"}


def test_the_same_submission_with_the_same_key_is_the_same_job(
    client: TestClient, archive: bytes, settings: Settings
) -> None:
    query = {"preset": "draft", "name": "moving"}
    first = client.post("/jobs", params=query, content=archive, headers=KEY)
    again = client.post("/jobs", params=query, content=archive, headers=KEY)
    assert (first.status_code, again.status_code) == (202, 202)
    assert first.json()["id"] == again.json()["id"]
    assert list((settings.data / "uploads").iterdir()) == []
    for other in ({"preset": "fine", "name": "moving"}, {"preset": "draft", "name": "standing"}):
        refused = client.post("/jobs", params=other, content=archive, headers=KEY)
        assert problem(refused, 422)["type"].endswith("idempotency-key-reused")
    other_key = client.post("/jobs", params=query, content=archive, headers={"Idempotency-Key": "a2"})
    assert other_key.json()["id"] != first.json()["id"]
    client.delete(f"/jobs/{first.json()['id']}")
    new = client.post("/jobs", params=query, content=archive, headers=KEY)
    assert (new.status_code, new.json()["id"] != first.json()["id"]) == (202, True)


def test_a_submission_that_the_database_refused_is_queued_by_its_key(
    client: TestClient, archive: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = client.app.state.context.engine  # type: ignore[attr-defined]

    def refuse(*_: object) -> None:
        raise JobError("no answer")

    with monkeypatch.context() as patch:
        patch.setattr(engine, "enqueue", refuse)
        assert client.post("/jobs?preset=draft", content=archive, headers=KEY).status_code == 503
    (stored,) = client.get("/jobs").json()["jobs"]
    assert client.post("/jobs?preset=draft", content=archive, headers=KEY).json()["id"] == stored["id"]
    assert engine.entries([stored["id"]])[stored["id"]].state is JobState.QUEUED


def test_jobs_are_found_by_state_and_name(client: TestClient, capture: Path, archive: bytes) -> None:
    jobs = {name: queue_job(client, capture, archive, name) for name in ("Anna", "hanna", "otto", "Annabel")}
    client.post(f"/jobs/{jobs['otto']}/cancel")
    client.post(f"/jobs/{jobs['Anna']}/cancel")

    def names(query: str) -> list[str]:
        found, path = [], f"/jobs?{query}"
        while path:
            page = client.get(path).json()
            found += [job["name"] for job in page["jobs"]]
            path = page["next"]
        return found

    assert names("name=anna") == ["Annabel", "hanna", "Anna"]
    assert names("name=anna&limit=1") == ["Annabel", "hanna", "Anna"]
    assert names("state=cancelled") == ["otto", "Anna"]
    assert names("state=cancelled&limit=1&name=t") == ["otto"]
    assert names("state=cancelled&state=queued") == ["Annabel", "otto", "hanna", "Anna"]
    assert names("state=running") == []
    assert client.get("/jobs?state=lost").status_code == 422


def test_a_job_says_how_long_it_has_waited(client: TestClient, job: str) -> None:
    first = client.get(f"/jobs/{job}").json()["queued_s"]
    assert 0 <= first < client.get(f"/jobs/{job}").json()["queued_s"]


def test_only_a_job_that_has_succeeded_is_extended(client: TestClient, job: str) -> None:
    for address, detail in (
        (f"/jobs/{job}/extend?iterations=5", "queued"),
        (f"/jobs/{'0' * 16}/extend?iterations=5", ""),
    ):
        answer = client.post(address)
        assert detail in problem(answer, 409 if detail else 404)["detail"]
    assert client.post(f"/jobs/{job}/extend").status_code == 422


@pytest.mark.parametrize(
    "path", ["/", "/docs", "/jobs", "/healthz", "/options", "/openapi.json", "/web/page.js", "/jobs/{job}", "/render"]
)
def test_head_has_the_headers_of_get_without_its_body(client: TestClient, model: str, path: str) -> None:
    address = path.replace("{job}", model)
    got, head = client.get(address), client.head(address)
    volatile = {"date", "x-request-id", "server-timing"}
    if path in ("/jobs", "/jobs/{job}"):  # seconds in the queue
        volatile.add("content-length")
    assert head.status_code == 200
    assert {k: v for k, v in head.headers.items() if k not in volatile} == {
        k: v for k, v in got.headers.items() if k not in volatile
    }


def test_head_of_a_stream_ends(client: TestClient, job: str) -> None:
    answer = client.head(f"/jobs/{job}/events")
    assert (answer.status_code, answer.headers["content-type"][:17]) == (200, "text/event-stream")


@pytest.mark.parametrize(
    ("path", "allowed"),
    [
        ("/jobs", "HEAD, GET, POST"),
        ("/jobs/{job}", "HEAD, GET, DELETE"),
        ("/jobs/{job}/cancel", "POST"),
        ("/session", "HEAD, GET, POST, DELETE"),
        ("/render", "HEAD, GET"),
        ("/web/page.js", "HEAD, GET"),
    ],
)
def test_a_wrong_method_is_told_the_right_ones(client: TestClient, job: str, path: str, allowed: str) -> None:
    answer = client.put(path.replace("{job}", job))
    assert problem(answer, 405)["status"] == 405
    assert answer.headers["allow"] == allowed
