"""Uploads that are continued: interrupted anywhere, by anything, they give the same capture as one that was not."""

from __future__ import annotations

import hashlib
import os
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from starlette.testclient import TestClient

from client import Client, ClientError, calls, retry_limit
from client import captures as sending
from service.app import create_app
from service.keys import Keys, Scope
from service.resumable import KEPT_S
from service.settings import Settings


def begin(client: TestClient, archive: bytes) -> str:
    answer = client.post(f"/uploads?bytes={len(archive)}")
    assert answer.status_code == 201
    assert answer.headers["Location"] == f"/uploads/{answer.json()['id']}"
    return str(answer.json()["id"])


def send(client: TestClient, upload: str, archive: bytes, start: int, end: int, content: bytes | None = None) -> int:
    """The status of a request with the bytes from `start` to `end`."""
    part = archive[start:end] if content is None else content
    headers = {"Content-Range": f"bytes {start}-{end - 1}/{len(archive)}"}
    return int(client.put(f"/uploads/{upload}", content=part, headers=headers).status_code)


def received(client: TestClient, upload: str) -> int:
    return int(client.get(f"/uploads/{upload}").json()["received"])


def test_parts_become_the_capture_that_the_whole_would_be(
    client: TestClient, archive: bytes, settings: Settings
) -> None:
    upload, middle = begin(client, archive), len(archive) // 2
    assert send(client, upload, archive, 0, middle) == 200
    assert client.post(f"/jobs?capture={upload}").status_code == 409
    assert send(client, upload, archive, middle, len(archive)) == 200
    job = client.post(f"/jobs?capture={upload}&preset=draft").json()
    assert job["capture"] == hashlib.sha256(archive).hexdigest()
    assert client.post("/jobs", content=archive).json()["capture"] == job["capture"]
    assert [path.suffix for path in (settings.data / "resumable").iterdir()] == [".json"]
    assert list((settings.data / "uploads").iterdir()) == []


def found(client: TestClient, path: str, content: bytes | None = None) -> dict[str, Any]:
    """Statistics of a capture as a route answers them, without the time they took."""
    answer = client.post(path, content=content)
    assert answer.status_code == 200, answer.text
    return {**answer.json()["statistics"], "cost_s": None}


@pytest.mark.parametrize("route", ["/captures", "/plans"])
def test_a_capture_is_looked_at_before_a_job_is_made_of_it_and_after_without_sending_it_again(
    client: TestClient, archive: bytes, settings: Settings, route: str
) -> None:
    whole = found(client, route, archive)
    upload = begin(client, archive)
    assert client.post(f"{route}?capture={upload}").status_code == 409
    send(client, upload, archive, 0, len(archive))
    assert found(client, f"{route}?capture={upload}") == whole
    assert received(client, upload) == len(archive)
    assert list((settings.data / "captures").iterdir()) == []
    job = client.post(f"/jobs?capture={upload}").json()
    for sent in (upload, job["capture"]):
        assert found(client, f"{route}?capture={sent}") == whole
    for unknown in ("0" * 32, "0" * 64):
        assert client.post(f"{route}?capture={unknown}").status_code == 404
    assert client.post(f"{route}?capture=x").status_code == 422
    assert list((settings.data / "uploads").iterdir()) == []


def test_a_request_for_a_job_may_be_sent_again(client: TestClient, archive: bytes) -> None:
    upload = begin(client, archive)
    send(client, upload, archive, 0, len(archive))
    headers = {"Idempotency-Key": "one"}
    first, second = (client.post(f"/jobs?capture={upload}", headers=headers).json()["id"] for _ in range(2))
    assert first == second
    before = client.get(f"/uploads/{upload}").json()["expires_at"]
    assert client.post(f"/jobs?capture={upload}").json()["id"] != first
    assert client.get(f"/uploads/{upload}").json()["expires_at"] == before
    for job in client.get("/jobs").json()["jobs"]:
        client.delete(f"/jobs/{job['id']}")
    gone = client.post(f"/jobs?capture={upload}")
    assert (gone.status_code, gone.json()["type"]) == (404, "urn:graings:problem:no-such-capture")


def test_an_upload_whose_bytes_are_gone_is_not_found(client: TestClient, archive: bytes, settings: Settings) -> None:
    """They expire, and another request for a job takes them."""
    upload = begin(client, archive)
    send(client, upload, archive, 0, len(archive))
    (settings.data / "resumable" / f"{upload}.part").unlink()
    for path in (f"/jobs?capture={upload}", f"/plans?capture={upload}", f"/captures?capture={upload}"):
        assert client.post(path).status_code == 404
    assert client.get(f"/uploads/{upload}").status_code == 404


def test_requests_at_once_for_jobs_of_one_upload_are_answered(client: TestClient, archive: bytes) -> None:
    upload = begin(client, archive)
    send(client, upload, archive, 0, len(archive))
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda _: client.post(f"/jobs?capture={upload}&preset=draft"), range(4)))
    codes = {answer.status_code for answer in answers}
    assert 202 in codes
    assert codes <= {202, 404, 409}  # nothing but what a client may send again
    assert client.post(f"/jobs?capture={upload}").status_code == 202


def test_an_upload_that_is_no_capture_stays_until_it_is_deleted(client: TestClient, settings: Settings) -> None:
    upload = begin(client, b"hello")
    send(client, upload, b"hello", 0, 5)
    assert client.post(f"/jobs?capture={upload}").json()["type"] == "urn:graings:problem:capture-rejected"
    assert received(client, upload) == 5
    assert client.delete(f"/uploads/{upload}").status_code == 204
    assert client.get(f"/uploads/{upload}").status_code == 404
    assert list((settings.data / "resumable").iterdir()) == []


def test_only_the_next_bytes_are_accepted(client: TestClient, archive: bytes) -> None:
    upload = begin(client, archive)
    assert send(client, upload, archive, 0, 100) == 200
    for start in (0, 99, 101):
        assert send(client, upload, archive, start, start + 50) == 409
    assert send(client, upload, archive, 100, 150, content=bytes(51)) == 409  # more than the range
    assert send(client, upload, archive + b"x", 100, 150) == 409  # another size
    beyond, backwards = f"bytes 100-{len(archive)}/{len(archive)}", f"bytes 5-4/{len(archive)}"
    wrong = {"bytes 100-/5": 422, "100-101/200": 422, "": 422, "bytes 5-4/9": 409, beyond: 409, backwards: 409}
    for text, status in wrong.items():
        assert client.put(f"/uploads/{upload}", content=b"x", headers={"Content-Range": text}).status_code == status
    assert received(client, upload) == 100


def test_the_limits_are_those_of_other_uploads(client: TestClient, settings: Settings) -> None:
    most = settings.max_upload_mb * 1_000_000
    assert client.post(f"/uploads?bytes={most}").status_code == 201
    assert client.post(f"/uploads?bytes={most + 1}").json()["type"] == "urn:graings:problem:bad-parameter"
    assert client.post("/uploads?bytes=0").status_code == 422
    large = begin(client, b"x" * 2_000)
    assert client.put(f"/uploads/{large}", content=bytes(most + 1)).status_code == 413


def test_an_upload_belongs_to_its_key(client: TestClient, archive: bytes, settings: Settings) -> None:
    keys = Keys(settings.data / "keys")
    own, other, admin, reader = (
        {"Authorization": f"Bearer {keys.create('x', scope)[1]}"}
        for scope in (Scope.TRAIN, Scope.TRAIN, Scope.ADMIN, Scope.READ)
    )
    assert client.post("/uploads?bytes=9", headers=reader).status_code == 403
    upload = client.post("/uploads?bytes=9", headers=own).json()["id"]
    part = {"Content-Range": "bytes 0-8/9"}
    assert client.put(f"/uploads/{upload}", headers=other | part, content=bytes(9)).status_code == 404
    assert client.get(f"/uploads/{upload}", headers=other).status_code == 404
    assert client.post(f"/jobs?capture={upload}", headers=other).json()["type"] == "urn:graings:problem:no-such-upload"
    assert client.delete(f"/uploads/{upload}", headers=other).status_code == 404
    assert client.get(f"/uploads/{upload}", headers=own).json()["received"] == 0
    assert client.get(f"/uploads/{upload}", headers=admin).status_code == 200


def test_an_upload_expires_a_day_after_its_last_part(client: TestClient, archive: bytes, settings: Settings) -> None:
    upload, folder = begin(client, archive), settings.data / "resumable"
    expires = client.get(f"/uploads/{upload}").json()["expires_at"]
    assert expires == pytest.approx(time.time() + KEPT_S, abs=60.0)
    for age, status in ((KEPT_S - 60, 200), (KEPT_S + 60, 404)):
        for path in folder.iterdir():
            os.utime(path, (time.time() - age,) * 2)
        assert client.get(f"/uploads/{upload}").status_code == status
    assert list(folder.iterdir()) == []


def test_a_restarted_service_continues(settings: Settings, archive: bytes) -> None:
    with TestClient(create_app(settings)) as client:
        upload = begin(client, archive)
        send(client, upload, archive, 0, 1_000)
    with TestClient(create_app(settings)) as client:
        assert received(client, upload) == 1_000
        assert send(client, upload, archive, 1_000, len(archive)) == 200
        assert client.post(f"/jobs?capture={upload}").status_code == 202


@pytest.fixture
def address(settings: Settings) -> Iterator[tuple[str, int]]:
    server = uvicorn.Server(uvicorn.Config(create_app(settings), port=0, log_level="critical"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    yield server.servers[0].sockets[0].getsockname()
    server.should_exit = True
    thread.join()


def test_an_upload_is_continued_from_any_byte(address: tuple[str, int], settings: Settings) -> None:
    """Bytes that arrive count at once; of those that arrive together with the end of the connection, some may not."""
    archive = os.urandom(300_000)
    with Client(f"http://{address[0]}:{address[1]}") as remote:
        upload = remote._do(calls.begin_upload(len(archive)))["id"]

        def arrived() -> int:
            return int(remote._do(calls.upload_state(upload))["received"])

        def interrupted(end: int) -> None:
            """A request for all the rest whose connection breaks before byte `end`."""
            start = arrived()
            head = (
                f"PUT /uploads/{upload} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {len(archive) - start}\r\n"
                f"Content-Range: bytes {start}-{len(archive) - 1}/{len(archive)}\r\n\r\n"
            )
            with socket.create_connection(address) as connection:
                connection.sendall(head.encode() + archive[start:end])
                limit = time.monotonic() + 3.0
                while end % 2 and arrived() < end and time.monotonic() < limit:
                    time.sleep(0.02)

        for end in (1, 2, 1_001, 65_535, 65_536, 65_537, 200_000, 299_999):
            interrupted(end)
            for _ in range(10):  # a request that was broken off may have written after this one asked
                if end % 2 and arrived() < end:
                    interrupted(end)
            assert arrived() == end if end % 2 else arrived() <= end
        start = arrived()
        while start < len(archive):  # the requests that were broken off may still be writing
            try:
                part = calls.send_part(upload, start, len(archive), len(archive))
                start = int(remote._do(part, iter((archive[start:],)))["received"])
            except ClientError:
                start = arrived()
    assert (settings.data / "resumable" / f"{upload}.part").read_bytes() == archive


class Flaky:
    """Passes connections on to `target`; breaks each after `allowed` bytes of requests, the next `left` times."""

    def __init__(self, target: tuple[str, int], allowed: int, left: int) -> None:
        self.target, self.allowed, self.left = target, allowed, left
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.threads = [threading.Thread(target=self._accept)]

    def __enter__(self) -> Flaky:
        self.threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        self.listener.shutdown(socket.SHUT_RDWR)
        for thread in self.threads:
            thread.join()
        self.listener.close()

    def _accept(self) -> None:
        with suppress(OSError):  # closed
            while True:
                near = self.listener.accept()[0]
                self.threads.append(threading.Thread(target=self._serve, args=(near,)))
                self.threads[-1].start()

    def _serve(self, near: socket.socket) -> None:
        with near, socket.create_connection(self.target) as far:
            back = threading.Thread(target=self._pass_on, args=(far, near, False))
            back.start()
            self._pass_on(near, far, True)
            back.join()

    def _pass_on(self, source: socket.socket, sink: socket.socket, counted: bool) -> None:
        passed = 0
        with suppress(OSError):  # the other direction is broken
            while data := source.recv(5_000):
                passed += len(data)
                if counted and self.left and passed > self.allowed:
                    self.left -= 1
                    break
                sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


def test_the_client_continues_over_a_connection_that_breaks(
    address: tuple[str, int], capture: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calls, "RECONNECT_S", 0.05)
    monkeypatch.setattr(sending, "CHUNK", 1_000)
    with Flaky(address, 3_000, left=3) as flaky, Client(f"http://127.0.0.1:{flaky.port}") as remote:
        job = remote.submit(capture, preset="draft")
        assert (job.state, flaky.left) == ("queued", 0)
        assert len(list((settings.data / "captures").rglob("*.png"))) == len(list(capture.rglob("*.png")))
        monkeypatch.setattr(retry_limit, "RETRY_FOR_S", 0.5)
        flaky.left, flaky.allowed = 10_000, 0
        with pytest.raises(ClientError, match="does not answer"):
            remote.upload(capture)
