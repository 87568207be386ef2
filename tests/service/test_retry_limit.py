"""What clients outlive: a service that restarts behind a proxy, and bodies that break on the way."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import pytest

from client import AsyncClient, Client, ClientError, RefusedError, asynchronous, blocking, calls, retry_limit
from client.captures import uploading

END = 'id: 3\nevent: end\ndata: {"state": "succeeded"}\n\n'
Answer = Callable[[httpx2.Request], httpx2.Response]


class Clock:
    """Time that passes only where a client sleeps, or where a test says so."""

    def __init__(self) -> None:
        self.now = 1_000.0

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()

    async def asleep(seconds: float) -> None:
        clock.sleep(seconds)

    monkeypatch.setattr(retry_limit.time, "monotonic", lambda: clock.now)
    monkeypatch.setattr(blocking.time, "sleep", clock.sleep)
    monkeypatch.setattr(asynchronous.asyncio, "sleep", asleep)
    return clock


def stream(text: str) -> httpx2.Response:
    return httpx2.Response(200, headers={"Content-Type": "text/event-stream"}, content=text.encode())


def refuse(request: httpx2.Request) -> httpx2.Response:
    raise httpx2.ConnectError("refused", request=request)


def kinds(answer: Answer, asynchronously: bool) -> list[str]:
    """The events of a job by a client whose requests `answer` answers."""
    transport = httpx2.MockTransport(answer)
    if not asynchronously:
        with Client(transport=transport) as client:
            return [event.kind for event in client.events("j")]

    async def follow() -> list[str]:
        async with AsyncClient(transport=transport) as client:
            return [event.kind async for event in client.events("j")]

    return asyncio.run(follow())


@pytest.mark.parametrize("asynchronously", [False, True])
@pytest.mark.parametrize("status", [None, 502, 503, 504])
def test_events_outlive_a_restart_after_quiet_minutes(clock: Clock, status: int | None, asynchronously: bool) -> None:
    """A job in the queue has no events: what counts is how long the service fails, not how long it was quiet."""
    asked: list[httpx2.Request] = []

    def answer(request: httpx2.Request) -> httpx2.Response:
        asked.append(request)
        if len(asked) == 1:
            clock.now += 300.0  # a connection without events, which ends when the service stops
            return stream(": ping\n\n")
        if len(asked) < 30:
            return refuse(request) if status is None else httpx2.Response(status, text="restarting")
        return stream(END)

    assert kinds(answer, asynchronously) == ["end"]


@pytest.mark.parametrize("asynchronously", [False, True])
@pytest.mark.parametrize("status", [None, 503])
def test_events_end_with_an_error_after_a_minute_of_failures(
    clock: Clock, status: int | None, asynchronously: bool
) -> None:
    def answer(request: httpx2.Request) -> httpx2.Response:
        return refuse(request) if status is None else httpx2.Response(status, json={})

    with pytest.raises(ClientError, match="does not answer" if status is None else "503"):
        kinds(answer, asynchronously)
    assert 60 < clock.now - 1_000 < 70


@pytest.mark.parametrize("asynchronously", [False, True])
@pytest.mark.parametrize("content", ["text/html", "text/event-stream"])
def test_streams_without_an_event_are_failures_too(clock: Clock, content: str, asynchronously: bool) -> None:
    def answer(request: httpx2.Request) -> httpx2.Response:
        return httpx2.Response(200, headers={"Content-Type": content}, text="<html>")

    with pytest.raises(ClientError, match="at once" if content == "text/event-stream" else "does not answer"):
        kinds(answer, asynchronously)
    assert 60 < clock.now - 1_000 < 70


@pytest.mark.parametrize("asynchronously", [False, True])
def test_events_of_a_job_that_is_not_there_are_an_error_at_once(clock: Clock, asynchronously: bool) -> None:
    with pytest.raises(RefusedError, match="404"):
        kinds(lambda request: httpx2.Response(404, json={}), asynchronously)
    assert clock.now == 1_000


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    path = tmp_path / "capture.zip"
    path.write_bytes(bytes(1_000))
    return path


def state(received: int) -> dict[str, Any]:
    return {"id": "u", "received": received}


def test_a_part_that_breaks_after_minutes_is_continued_where_it_broke(archive: Path, clock: Clock) -> None:
    steps = uploading(archive, None)
    next(steps)
    call, _, _ = steps.send(state(0))
    assert call.method == "PUT"
    clock.now += 75.0
    call, _, _ = steps.throw(ClientError("broke"))
    assert call.method == "GET"  # how far did it come?
    call, content, _ = steps.send(state(600))
    assert call.headers["Content-Range"] == "bytes 600-999/1000"
    assert content is not None
    with pytest.raises(StopIteration):
        steps.send(state(1_000))


def test_a_part_of_which_nothing_arrives_is_sent_again_for_a_minute(archive: Path, clock: Clock) -> None:
    steps = uploading(archive, None)
    next(steps)
    steps.send(state(0))
    parts = 0

    def break_often() -> None:
        nonlocal parts
        while parts < 20:
            parts += 1
            clock.now += 20.0  # a proxy that keeps the body back loses all of it
            steps.throw(ClientError("broke"))
            steps.send(state(0))

    with pytest.raises(ClientError, match="broke"):
        break_often()
    assert 4 <= parts <= 5


def test_an_upload_that_is_refused_is_an_error_at_once(archive: Path, clock: Clock) -> None:
    steps = uploading(archive, None)
    next(steps)
    steps.send(state(0))
    with pytest.raises(RefusedError, match="413"):
        steps.throw(RefusedError(413, {}))


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("target", (0, 0, 1.5), "0.0,0.0,1.5"),
        ("target", "0,0,1.5", "0,0,1.5"),
        ("pose", [[1, 0], [0, 1]], "[[1.0, 0.0], [0.0, 1.0]]"),
        ("pose", "[[1, 0], [0, 1]]", "[[1, 0], [0, 1]]"),
        ("t", 0.5, "0.5"),
    ],
)
def test_parameters_of_a_view_are_numbers_or_the_text_of_the_address(name: str, value: Any, text: str) -> None:
    assert calls.render(None, {name: value}).query == {name: text}


def test_a_job_has_a_name_that_the_service_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "walker"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert calls.job_name(None, ".") == "walker"
    assert calls.job_name(None, "x" * 300) == "x" * 120
    assert calls.job_name("mine", ".") == "mine"


def test_a_camera_path_is_sent_with_the_length_of_its_body(tmp_path: Path) -> None:
    """`path` is a field of the body too."""
    sent: list[httpx2.Request] = []
    task = {"state": "succeeded", "error": None, "links": {"self": "/t", "video": "/t/video"}}

    def answer(request: httpx2.Request) -> httpx2.Response:
        request.read()
        sent.append(request)
        return httpx2.Response(202, json=task) if request.method == "POST" else httpx2.Response(200, content=b"video")

    with Client(transport=httpx2.MockTransport(answer)) as client:
        client.video("j", tmp_path / "a.mp4", path={"keys": []}, seconds=2)
    assert json.loads(sent[0].content) == {"format": "mp4", "path": {"keys": []}, "seconds": 2}
    assert sent[0].headers["content-length"] == str(len(sent[0].content))
    assert (tmp_path / "a.mp4").read_bytes() == b"video"
