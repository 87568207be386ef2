"""The limits of a key: sessions count too, and event streams do not take the place of short requests."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from starlette.testclient import TestClient

from service.app import create_app
from service.keys import Keys, Scope
from service.problems import TooManyRequests
from service.request_limits import RequestLimits
from service.settings import Settings
from tests.service.test_access import add_job, bearer, keys  # noqa: F401
from tests.service.test_jobs import problem


def test_requests_and_streams_are_counted_apart() -> None:
    limits = RequestLimits(1_000, 2, 1)
    with limits.counted("a"), limits.counted("a"):
        with pytest.raises(TooManyRequests, match="2 open requests"), limits.counted("a"):
            pass
        limits_of_b, stream = limits.counted("b"), limits.counted("a", "event streams")
        with limits_of_b, stream, pytest.raises(TooManyRequests, match="1 open event streams"):
            limits.counted("a", "event streams").__enter__()
    with limits.counted("a"), limits.counted("a", "event streams"):  # those before have ended
        pass


def test_a_request_frees_its_place_when_it_ends_also_by_an_error(settings: Settings, keys: Keys) -> None:  # noqa: F811
    one = settings.model_copy(update={"key_open_requests": 1})
    headers = bearer(keys.create("1", Scope.TRAIN)[1])
    with TestClient(create_app(one)) as client:
        assert [client.get(f"/jobs/{'0' * 16}", headers=headers).status_code for _ in range(3)] == [404] * 3
        assert [client.get("/options", headers=headers).status_code for _ in range(3)] == [200] * 3


def test_open_streams_do_not_take_the_place_of_short_requests(
    settings: Settings,
    keys: Keys,  # noqa: F811
    capture: Path,
) -> None:
    few = settings.model_copy(update={"key_open_requests": 1, "key_open_streams": 2})
    owner, _ = keys.create("owner", Scope.TRAIN)
    with TestClient(create_app(few)) as client:
        job = add_job(client, capture, owner.id)
        _, secret = keys.create("link", Scope.VIEW, "link", parent=owner.id, job=job)
        headers, statuses = bearer(secret), list[int]()

        def follow() -> None:
            statuses.append(client.get(f"/jobs/{job}/events", headers=headers).status_code)

        threads = [threading.Thread(target=follow) for _ in range(3)]
        for thread in threads:
            thread.start()
        try:
            deadline = time.monotonic() + 30
            while not statuses:  # the one too many
                assert time.monotonic() < deadline
                time.sleep(0.05)
            assert statuses == [429]
            for path in (f"/jobs/{job}", "/jobs"):
                assert client.get(path, headers=headers).status_code == 200
        finally:
            client.app.state.context.jobs.cancel(job)  # type: ignore[attr-defined]
            for thread in threads:
                thread.join()
        assert statuses == [429, 200, 200]


@pytest.mark.parametrize("kind", ["key", "link"])
def test_beginning_a_session_counts_as_a_request_of_its_key(
    settings: Settings,
    keys: Keys,  # noqa: F811
    kind: str,
) -> None:
    few = settings.model_copy(update={"key_requests": 3})
    owner, secret = keys.create("owner", Scope.TRAIN)
    if kind == "link":
        _, secret = keys.create("link", Scope.VIEW, "link", parent=owner.id, job="0" * 16)
    with TestClient(create_app(few)) as client:
        answers = [client.post("/session", headers=bearer(secret)) for _ in range(4)]
        assert [answer.status_code for answer in answers] == [204, 204, 204, 429]
        assert problem(answers[-1], 429)["type"].endswith("too-many-requests")
        assert 1 <= int(answers[-1].headers["retry-after"]) <= 60
        assert sum(key.kind == "session" for key in keys.all()) == 3
        assert client.get("/jobs").status_code == 429  # the session shares the limit


def test_expired_sessions_are_looked_for_once_an_hour(
    settings: Settings,
    keys: Keys,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks: list[int] = []
    everything = Keys.all

    def counted(self: Keys) -> object:
        looks.append(1)
        return everything(self)

    secret = keys.create("me", Scope.TRAIN)[1]
    began, minutes = time.monotonic(), 0.0
    clock = SimpleNamespace(time=time.time, monotonic=lambda: began + 60 * minutes)
    monkeypatch.setattr("service.keys.time", clock)
    monkeypatch.setattr(Keys, "all", counted)
    with TestClient(create_app(settings)) as client:
        for minutes, expected in ((0, 1), (1, 1), (59, 1), (61, 2), (62, 2), (122, 3)):
            assert client.post("/session", headers=bearer(secret)).status_code == 204
            assert len(looks) == expected, minutes
