"""The same queue and leases on a PostgreSQL server that is started for the test, if PostgreSQL is installed."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import psycopg
import pytest

from jobs.engine import Engine
from jobs.job import JobError, JobState
from jobs.lease import PostgresLeases, open_leases
from jobs.queue import JobQueue
from jobs.store import Store
from jobs.webhooks import PRIVATE
from tests.jobs.postgres_server import Server, is_installed, running
from tests.jobs.test_webhooks import Receiver, wait_for_end, working_here
from tests.jobs.test_webhooks import receiver as receiver
from tests.jobs.test_webhooks import submit as submit_with_webhook
from tests.jobs.test_worker import ENDLESS, is_idle, submit, until, working

pytestmark = pytest.mark.slow(reason="starts a PostgreSQL server and real workers")


@contextmanager
def serving() -> Iterator[Server]:
    """A server for as long as the context lasts; skips the test if PostgreSQL is not installed."""
    if not is_installed():
        pytest.skip("PostgreSQL is not installed")
    with running() as server:
        yield server


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as server:
        yield server


@pytest.fixture
def url(server: Server) -> str:
    return server.url


def test_a_lease_ends_with_its_session(url: str, tmp_path: Path) -> None:
    first, second = open_leases(url, tmp_path), open_leases(url, tmp_path)
    assert isinstance(first, PostgresLeases)
    assert first.acquire("a")
    assert not second.acquire_from_dead("a")
    assert second.alive() == 1
    first.close()
    until(lambda: second.alive() == 0)
    assert second.acquire_from_dead("a")
    second.release("a")
    assert second.alive() == 0
    second.close()


def test_a_lease_whose_connection_was_closed_is_acquired_again_unless_another_holds_it(
    url: str, tmp_path: Path
) -> None:
    first, second = open_leases(url, tmp_path), open_leases(url, tmp_path)
    assert isinstance(first, PostgresLeases)
    assert first.acquire("a")
    first._connection.close()
    assert first.renew("a")
    assert not second.acquire("a")
    first._connection.close()
    until(lambda: second.acquire("a"))
    assert not first.renew("a")
    first.close()
    second.close()


def test_leases_raise_while_the_database_is_stopped_and_work_after_its_restart(server: Server, tmp_path: Path) -> None:
    holder, observer = open_leases(server.url, tmp_path), open_leases(server.url, tmp_path)
    assert holder.acquire("a")
    assert observer.alive() == 1
    with server.stopped():
        for ask in (observer.alive, lambda: holder.renew("a"), lambda: observer.acquire_from_dead("a")):
            with pytest.raises(JobError, match="does not answer"):
                ask()
    assert observer.alive() == 0
    assert holder.renew("a")
    assert observer.alive() == 1
    assert not observer.acquire("a")
    holder.close()
    observer.close()


def test_the_server_notices_within_half_a_minute_that_the_machine_of_a_lease_is_gone(url: str, tmp_path: Path) -> None:
    leases = open_leases(url, tmp_path)
    assert isinstance(leases, PostgresLeases)
    for _ in range(2):  # the first session, and the one after it was closed
        idle, interval, count = (
            int(str(leases._value(f"select current_setting('tcp_keepalives_{name}')")))
            for name in ("idle", "interval", "count")
        )
        assert 0 < idle + interval * count <= 30
        leases._connection.close()
        leases.alive()
    leases.close()


def test_leases_in_other_databases_of_the_server_do_not_count(url: str, tmp_path: Path) -> None:
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute("create database other")
    here, there = open_leases(url, tmp_path), open_leases(url.replace("/postgres", "/other"), tmp_path)
    assert there.acquire("a")
    assert (here.alive(), there.alive()) == (0, 1)
    here.close()
    there.close()


def test_waiting_for_the_session_of_another_thread_has_a_limit(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jobs.lease._SESSION_WAIT_S", 0.1)
    leases = open_leases(url, tmp_path)
    assert isinstance(leases, PostgresLeases)
    with leases._guard, ThreadPoolExecutor() as pool, pytest.raises(JobError, match="does not answer"):
        pool.submit(leases.alive).result(10)
    assert leases.alive() == 0
    leases.close()


def test_a_database_for_leases_that_cannot_be_opened_is_named_without_its_password(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="cannot be opened") as caught:
        open_leases("postgresql://127.0.0.1:1/none?user=me&password=secret", tmp_path)
    assert "secret" not in str(caught.value)


def test_every_operation_on_the_queue_fails_at_once_while_the_database_is_stopped(server: Server) -> None:
    engine = Engine(server.url)
    engine.enqueue("a", 10)
    operations: list[Callable[[], object]] = [
        lambda: engine.enqueue("b", 10),
        lambda: engine.entries(["a"]),
        engine.running,
        engine.waiting,
        lambda: engine.cancel("a"),
        lambda: engine.requeue(["a"]),
        lambda: engine.rewind("a"),
        lambda: engine.delete("a"),
    ]
    with ThreadPoolExecutor(len(operations)) as pool, server.stopped():
        for answer in [pool.submit(operation) for operation in operations]:
            with pytest.raises(JobError, match="does not answer"):
                answer.result(10)
    assert engine.entries(["a", "b"]).keys() == {"a"}
    engine.delete("a")
    engine.close()


def test_a_worker_survives_a_restart_of_the_database_and_can_end_while_it_is_stopped(
    server: Server, tmp_path: Path
) -> None:
    engine, observer = Engine(server.url), open_leases(server.url, tmp_path)
    jobs = JobQueue(Store(tmp_path / "data"), engine)
    job_id = submit(jobs, ENDLESS)
    folder = jobs.store.folder(job_id)
    with working(jobs, server.url) as worker:
        until(lambda: folder.checkpoint())
        with server.stopped():
            reached = folder.checkpoint() or 0
            time.sleep(3.0)  # longer than a round of the worker
            until(lambda: (folder.checkpoint() or 0) > reached)
        until(lambda: observer.alive() == 1)
        assert jobs.get(job_id).state is JobState.RUNNING
        assert len(folder.attempts()) == 1
        with server.stopped():
            worker.terminate()
            assert worker.wait(60) == 0
            assert is_idle(jobs, job_id)
    assert observer.alive() == 0
    with working(jobs, server.url):  # takes the job that the first worker could not return
        until(lambda: len(folder.attempts()) == 2)
        jobs.cancel(job_id)
        until(lambda: is_idle(jobs, job_id))
    observer.close()
    engine.close()


def test_another_worker_continues_the_job_of_a_killed_one(url: str, tmp_path: Path) -> None:
    engine = Engine(url)
    jobs = JobQueue(Store(tmp_path / "data"), engine)
    job_id = submit(jobs, ENDLESS)
    folder = jobs.store.folder(job_id)
    with working(jobs, url) as first, working(jobs, url) as second:
        until(lambda: folder.checkpoint())
        owner = folder.attempts()[0].worker
        next(process for process in (first, second) if f"-{process.pid}-" in owner).send_signal(signal.SIGKILL)
        until(lambda: len(folder.attempts()) == 2)
        taken_over = folder.attempts()[1]
        assert taken_over.worker != owner
        until(lambda: (folder.checkpoint() or 0) > taken_over.checkpoint > 0)
        assert jobs.cancel(job_id).state is JobState.CANCELLED
        until(lambda: is_idle(jobs, job_id))
    engine.close()


def test_a_webhook_is_told_after_failures_and_again_when_the_job_was_extended(
    url: str, tmp_path: Path, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jobs.worker.RETRY_AFTER_S", (0.2,) * 5)
    monkeypatch.setenv(PRIVATE, "1")
    receiver.statuses = [500, 503, 200]
    engine = Engine(url)
    jobs = JobQueue(Store(tmp_path / "data"), engine)
    job = submit_with_webhook(jobs, receiver.url)
    with working_here(jobs, url):
        messages = wait_for_end(jobs, job, receiver)
        ids = [headers["webhook-id"] for headers, _ in receiver.got]
        assert ids.count(f"{job}.started.1") == 3  # two failures, then success
        until(lambda: is_idle(jobs, job))
        jobs.extend(job, 20)
        messages = wait_for_end(jobs, job, receiver, ends=2)
        until(lambda: is_idle(jobs, job))
    ended = [message["data"]["checkpoint"] for message in messages if message["type"] == "job.ended"]
    assert ended == [30, 50]
    assert jobs.get(job).state is JobState.SUCCEEDED
    jobs.delete(job)
    engine.close()
