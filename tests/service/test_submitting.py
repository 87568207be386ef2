"""A submission whose answer is lost makes one job all the same, and one that is refused leaves nothing behind."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import httpx2
import pytest
from starlette.testclient import TestClient

from client import AsyncClient, Client, ClientError, RefusedError
from service.settings import Settings
from tests.service.test_retry_limit import Clock, clock  # noqa: F401

JOB = {"id": "j", "name": "n", "state": "queued", "error": None, "checkpoint": None, "progress": None}
Failure = int | type[httpx2.TransportError]
LOST: list[Failure] = [httpx2.ConnectError, httpx2.ReadError, httpx2.ReadTimeout, 404, 408, 409, 502, 503, 504]


class Service:
    """Answers `POST /jobs` with `failures` in turn and then with a job, and keeps every request."""

    def __init__(self, failures: Iterable[Failure], deletion: Failure = 204) -> None:
        self.failures = iter(failures)
        self.deletion = deletion
        self.got: list[httpx2.Request] = []

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        request.read()
        return self.answer(request)

    async def later(self, request: httpx2.Request) -> httpx2.Response:
        await request.aread()
        return self.answer(request)

    def answer(self, request: httpx2.Request) -> httpx2.Response:
        self.got.append(request)
        if request.method == "DELETE":
            return self.fail(self.deletion, request)
        if request.url.path.startswith("/uploads"):
            return httpx2.Response(200, json={"id": "u", "received": len(request.content)})
        failure = next(self.failures, None)
        return httpx2.Response(202, json=JOB) if failure is None else self.fail(failure, request)

    def fail(self, failure: Failure, request: httpx2.Request) -> httpx2.Response:
        if isinstance(failure, int):
            return httpx2.Response(failure, json={"detail": f"answer {failure}"})
        raise failure("broke", request=request)

    def sent(self, method: str, path: str) -> list[httpx2.Request]:
        return [request for request in self.got if (request.method, request.url.path) == (method, path)]


def submit(service: Service, asynchronously: bool, method: str, *arguments: Any, **options: Any) -> str:
    """The id of the job that a method of a client makes."""
    if not asynchronously:
        with Client(transport=httpx2.MockTransport(service)) as client:
            return str(getattr(client, method)(*arguments, **options).id)

    async def use() -> str:
        async with AsyncClient(transport=httpx2.MockTransport(service.later)) as client:
            return str((await getattr(client, method)(*arguments, **options)).id)

    return asyncio.run(use())


@pytest.fixture
def packed(tmp_path: Path) -> Path:
    path = tmp_path / "capture.zip"
    path.write_bytes(bytes(1_000))
    return path


@pytest.mark.parametrize("asynchronously", [False, True])
@pytest.mark.parametrize("failure", LOST)
def test_a_request_for_a_job_is_sent_again_with_its_key(
    packed: Path,
    clock: Clock,  # noqa: F811
    failure: Failure,
    asynchronously: bool,
) -> None:
    methods = [("submit", packed)]
    if failure not in (httpx2.ConnectError, 404):
        methods.append(("submit_scene", "walker"))  # of a scene these are the first and the last answer, below
    for method, argument in methods:
        service = Service([failure] * 3)
        assert submit(service, asynchronously, method, argument) == "j"
        requests = service.sent("POST", "/jobs")
        assert len(requests) == 4
        assert len({(request.url, request.headers["idempotency-key"]) for request in requests}) == 1
        assert len(service.sent("POST", "/uploads")) == (method == "submit")
        assert service.sent("DELETE", "/uploads/u") == []


@pytest.mark.parametrize("asynchronously", [False, True])
@pytest.mark.parametrize("failure", [httpx2.ConnectError, 404])
def test_a_scene_is_not_asked_for_again_where_there_is_no_service(
    clock: Clock,  # noqa: F811
    failure: Failure,
    asynchronously: bool,
) -> None:
    service = Service([failure] * 3)
    with pytest.raises(ClientError, match="answer 404" if failure == 404 else "Is the service running there"):
        submit(service, asynchronously, "submit_scene", "walker")
    assert len(service.got) == 1
    assert clock.now == 1_000


@pytest.mark.parametrize("asynchronously", [False, True])
def test_a_service_that_restarts_while_a_scene_is_asked_for_is_waited_for(
    clock: Clock,  # noqa: F811
    asynchronously: bool,
) -> None:
    service = Service([httpx2.ReadError, httpx2.ConnectError, httpx2.ConnectError])
    assert submit(service, asynchronously, "submit_scene", "walker") == "j"
    assert len(service.sent("POST", "/jobs")) == 4


@pytest.mark.parametrize("asynchronously", [False, True])
@pytest.mark.parametrize("failure", [httpx2.ConnectError, 502])
def test_a_request_for_a_job_is_given_up_after_a_minute_of_failures(
    packed: Path,
    clock: Clock,  # noqa: F811
    failure: Failure,
    asynchronously: bool,
) -> None:
    with pytest.raises(ClientError, match="answer 502" if failure == 502 else "does not answer"):
        submit(service := Service([failure] * 1_000), asynchronously, "submit", packed)
    assert 60 < clock.now - 1_000 < 70
    assert service.sent("DELETE", "/uploads/u") == []  # the service may still make a job of it


@pytest.mark.parametrize("asynchronously", [False, True])
@pytest.mark.parametrize("deletion", [204, 404, 500, httpx2.ReadError])
@pytest.mark.parametrize("status", [401, 403, 413, 422])
def test_a_refused_submission_gives_its_upload_up_and_tells_the_refusal(
    packed: Path,
    clock: Clock,  # noqa: F811
    status: int,
    deletion: Failure,
    asynchronously: bool,
) -> None:
    service = Service([status], deletion)
    with pytest.raises(RefusedError, match=f"answer {status}") as refused:
        submit(service, asynchronously, "submit", packed)
    assert refused.value.status == status
    assert len(service.sent("POST", "/jobs")) == len(service.sent("DELETE", "/uploads/u")) == 1


@pytest.mark.parametrize("asynchronously", [False, True])
def test_preset_and_options_go_with_the_beginning_of_the_upload(packed: Path, asynchronously: bool) -> None:
    service = Service([])
    submit(service, asynchronously, "submit", packed, preset="draft", config={"iterations": 7})
    first = service.got[0]
    assert (first.method, first.url.path) == ("POST", "/uploads")
    assert dict(first.url.params) == {"bytes": "1000", "preset": "draft", "config": '{"iterations": 7}'}


@pytest.mark.parametrize(
    ("query", "part"),
    [
        ({"preset": "nonsense"}, "nonsense"),
        ({"config": '{"iterations": -1}'}, "iterations"),
        ({"preset": "draft", "config": '{"no.such": 1}'}, "no"),
        ({"config": "{"}, "config"),
    ],
)
def test_a_wrong_preset_or_option_is_refused_before_anything_is_sent(
    client: TestClient, settings: Settings, query: dict[str, str], part: str
) -> None:
    refused = client.post("/uploads", params={"bytes": 1_000, **query})
    assert refused.status_code == 422
    assert part in refused.json()["detail"]
    assert list((settings.data / "resumable").iterdir()) == []
    right = {"bytes": 1_000, "preset": "draft", "config": '{"iterations": 7}'}
    assert client.post("/uploads", params=right).status_code == 201
