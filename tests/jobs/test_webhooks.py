"""What a receiver of webhooks gets, from a real worker and over real connections."""

from __future__ import annotations

import json
import socket
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest
from standardwebhooks import Webhook

from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from jobs.commands import default_database
from jobs.engine import MESSAGES, Engine
from jobs.job import JobSpec
from jobs.lease import FileLeases
from jobs.queue import JobQueue
from jobs.webhooks import PRIVATE, WebhookError, deliver
from jobs.worker import Worker, requeue_work_of_dead_workers

LONG_S = 120.0
SECRET = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"


class Receiver:
    """A server that answers with `statuses` in turn, the last one for ever, and keeps what it got."""

    def __init__(self) -> None:
        self.statuses = [200]
        self.location = ""
        self.got: list[tuple[dict[str, str], bytes]] = []
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver.got.append((dict(self.headers), body))
                status = receiver.statuses[0] if len(receiver.statuses) == 1 else receiver.statuses.pop(0)
                self.send_response(status)
                if receiver.location:
                    self.send_header("Location", receiver.location)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self._server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://localhost:{self._server.server_port}/hook"
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05})
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    receiver = Receiver()
    yield receiver
    receiver.close()


def submit(jobs: JobQueue, webhook: str) -> str:
    unpacked = write_synthetic(jobs.store.uploads / "u", frames=6, size=24)
    options = {"iterations": 30, "init.points": 300, "evaluation.views": 1, "evaluation.checkpoint_every": 10}
    config = make_config("draft", options).model_dump(mode="json")
    return jobs.submit(JobSpec("job", "0" * 64, config, webhook=webhook), unpacked).id


@contextmanager
def working_here(jobs: JobQueue, database: str) -> Iterator[None]:
    """A worker in a thread of this process, so that its constants can be changed."""
    stop = threading.Event()
    worker = Worker(jobs.store, database)
    thread = threading.Thread(target=worker.run, args=(stop,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def wait_for_end(jobs: JobQueue, job: str, receiver: Receiver, ends: int = 1) -> list[dict[str, Any]]:
    """The messages of a job so far, once `ends` of them say that it ended; refused or not, each one is verified."""
    secret = jobs.get(job).spec.webhook_secret
    assert secret is not None
    deadline = time.monotonic() + LONG_S
    while True:
        messages = [Webhook(secret).verify(body, headers) for headers, body in receiver.got]
        if sum(message["type"] == "job.ended" for message in messages) >= ends:
            return messages
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_a_job_tells_its_webhook_what_happens_and_tries_again(
    jobs: JobQueue, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jobs.worker.RETRY_AFTER_S", (0.2,) * 5)
    monkeypatch.setenv(PRIVATE, "1")
    receiver.statuses = [500, 503, 200]
    job = submit(jobs, receiver.url)
    with working_here(jobs, default_database(jobs.store.root)):
        messages = wait_for_end(jobs, job, receiver)
    ids = [headers["webhook-id"] for headers, _ in receiver.got]
    assert ids.count(f"{job}.started.1") == 3  # two failures, then success
    assert messages[0]["type"] == "job.started"
    ended = next(message for message in messages if message["type"] == "job.ended")
    assert ended["data"] == {"id": job, "name": "job", "state": "succeeded", "error": None, "checkpoint": 30}
    assert {message["type"] for message in messages} <= {"job.started", "job.checkpoint", "job.ended"}
    jobs.delete(job)


def test_a_cancelled_job_says_so(jobs: JobQueue) -> None:
    job = submit(jobs, "http://receiver.example/")
    jobs.cancel(job)
    engine = Engine(default_database(jobs.store.root))
    (message,) = engine._in_state("ENQUEUED", MESSAGES)
    assert message.workflow_id.startswith(f"{job}.ended.")
    jobs.delete(job)
    assert engine._in_state("ENQUEUED", MESSAGES) == []
    engine.close()


def send(url: str, private: bool) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(PRIVATE, "1" if private else "")
        deliver(url, SECRET, "id", {"type": "job.ended"})


def test_an_address_inside_the_network_is_refused_unless_allowed(receiver: Receiver) -> None:
    with pytest.raises(WebhookError, match="private network"):
        send(receiver.url, False)
    assert receiver.got == []
    send(receiver.url, True)
    headers, body = receiver.got[0]
    assert headers["Host"] == receiver.url.split("/")[2]
    assert json.loads(body) == Webhook(SECRET).verify(body, headers)


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "10.1.2.3", "192.168.0.1", "169.254.169.254", "100.64.0.1", "0.0.0.0", "[::1]", "[fe80::1]",
             "[fd00::1]", "[::ffff:127.0.0.1]", "2130706433", "0x7f.1", "224.0.0.1"],
)  # fmt: skip
def test_no_spelling_of_an_inner_address_is_taken(host: str) -> None:
    with pytest.raises(WebhookError, match="private network"):
        send(f"http://{host}/", False)


@pytest.mark.parametrize("url", ["http://nowhere.invalid/", "http://127.0.0.1:9/", "http://", "ftp://127.0.0.1/"])
def test_a_receiver_that_does_not_answer_is_an_error(url: str) -> None:
    with pytest.raises(WebhookError):
        send(url, True)


def test_a_redirect_is_not_followed(receiver: Receiver) -> None:
    receiver.statuses, receiver.location = [307], receiver.url
    with pytest.raises(WebhookError, match="answered 307"):
        send(receiver.url, True)
    assert len(receiver.got) == 1


def test_a_message_of_a_dead_worker_is_delivered_by_another(jobs: JobQueue) -> None:
    job = submit(jobs, "http://receiver.example/")
    jobs.cancel(job)
    engine = Engine(default_database(jobs.store.root))
    (message,) = engine._in_state("ENQUEUED", MESSAGES)
    with (
        closing(sqlite3.connect(jobs.store.root / "jobs.sqlite")) as database,
        database,
    ):  # as a killed worker leaves it
        database.execute(
            "update workflow_status set status = 'PENDING', executor_id = 'dead' where workflow_uuid = ?",
            (message.workflow_id,),
        )
    assert engine.taken() == {message.workflow_id: "dead"}
    requeue_work_of_dead_workers(engine, FileLeases(jobs.store.workers), engine.taken(), "own")
    assert engine.taken() == {}
    assert [status.workflow_id for status in engine._in_state("ENQUEUED", MESSAGES)] == [message.workflow_id]
    engine.close()


@pytest.mark.parametrize("answer", [b"HTTP/1.1 200 OK\r\nX-Slow: " + b"a" * 1_000, b"H" * 1_000])
def test_a_receiver_that_answers_byte_by_byte_has_one_deadline(monkeypatch: pytest.MonkeyPatch, answer: bytes) -> None:
    """Else four of them hold all places of deliveries for ever."""
    monkeypatch.setattr("jobs.webhooks.TIMEOUT_S", 0.5)
    stop = threading.Event()

    def drip(server: socket.socket) -> None:
        connection, _ = server.accept()
        with connection, suppress(OSError):
            for byte in answer:
                if stop.wait(0.1):
                    return
                connection.sendall(bytes([byte]))

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=drip, args=(server,))
        thread.start()
        limit = threading.Timer(8.0, stop.set)  # so that the test ends where there is no deadline
        limit.start()
        began = time.monotonic()
        try:
            with pytest.raises(WebhookError, match=r"within 0\.5 s"):
                send(f"http://127.0.0.1:{server.getsockname()[1]}/", True)
            assert time.monotonic() - began < 4.0
        finally:
            limit.cancel()
            stop.set()
            thread.join()
