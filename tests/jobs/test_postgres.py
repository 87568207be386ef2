"""The same queue and leases on a PostgreSQL server that is started for the test, where its programs are installed."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import socket
import subprocess
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
from tests.jobs.test_worker import ENDLESS, resting, submit, until, working

pytestmark = pytest.mark.slow(reason="starts a PostgreSQL server and real workers")


def _user() -> str | None:
    """Whom the server runs as: it refuses root."""
    return "postgres" if os.geteuid() == 0 else pwd.getpwuid(os.geteuid()).pw_name


class Server:
    """A PostgreSQL server of our own, that can be stopped and started again."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.url = f"postgresql://grain@127.0.0.1:{self.port}/postgres"
        self._user = _user()
        for parent in (folder, *folder.parents[:2]):
            parent.chmod(0o755)
        self._data = folder / "data"
        self._data.mkdir(mode=0o700)
        shutil.chown(self._data, self._user)
        command = ["initdb", "-D", self._data, "-U", "grain", "-A", "trust", "-N"]
        subprocess.run(command, user=self._user, cwd=self._data, check=True)
        self.start()

    def start(self) -> None:
        settings = ["-c", f"unix_socket_directories={self._data}", "-c", "fsync=off"]
        command = ["postgres", "-D", self._data, "-p", str(self.port), *settings]
        self._process = subprocess.Popen(command, user=self._user, cwd=self._data)
        ready = ["pg_isready", "-h", "127.0.0.1", "-p", str(self.port), "-q"]
        until(lambda: subprocess.run(ready, check=False).returncode == 0)

    def stop(self) -> None:
        self._process.send_signal(signal.SIGINT)  # end now, and tidily
        self._process.wait()

    @contextmanager
    def away(self) -> Iterator[None]:
        self.stop()
        try:
            yield
        finally:
            self.start()


@contextmanager
def serving(factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server for as long as the context lasts; skips the test where its programs are not installed."""
    if shutil.which("initdb") is None or shutil.which("postgres") is None:
        pytest.skip("PostgreSQL is not installed")
    server = Server(factory.mktemp("postgres"))
    try:
        yield server
    finally:
        server.stop()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory) as server:
        yield server


@pytest.fixture
def url(server: Server) -> str:
    return server.url


def test_a_lease_ends_with_its_session(url: str, tmp_path: Path) -> None:
    first, second = open_leases(url, tmp_path), open_leases(url, tmp_path)
    assert isinstance(first, PostgresLeases)
    assert first.take("a")
    assert not second.take_from_the_dead("a")
    assert second.alive() == 1
    first.close()
    until(lambda: second.alive() == 0)
    assert second.take_from_the_dead("a")
    second.release("a")
    assert second.alive() == 0
    second.close()


def test_a_lease_lost_with_its_connection_is_taken_again_unless_another_has_it(url: str, tmp_path: Path) -> None:
    first, second = open_leases(url, tmp_path), open_leases(url, tmp_path)
    assert isinstance(first, PostgresLeases)
    assert first.take("a")
    first._connection.close()
    assert first.keep("a")
    assert not second.take("a")
    first._connection.close()
    until(lambda: second.take("a"))
    assert not first.keep("a")
    first.close()
    second.close()


def test_leases_say_that_the_database_is_away_and_go_on_when_it_is_back(server: Server, tmp_path: Path) -> None:
    holder, looker = open_leases(server.url, tmp_path), open_leases(server.url, tmp_path)
    assert holder.take("a")
    assert looker.alive() == 1
    with server.away():
        for ask in (looker.alive, lambda: holder.keep("a"), lambda: looker.take_from_the_dead("a")):
            with pytest.raises(JobError, match="does not answer"):
                ask()
    assert looker.alive() == 0
    assert holder.keep("a")
    assert looker.alive() == 1
    assert not looker.take("a")
    holder.close()
    looker.close()


def test_leases_in_other_databases_of_the_server_do_not_count(url: str, tmp_path: Path) -> None:
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute("create database other")
    here, there = open_leases(url, tmp_path), open_leases(url.replace("/postgres", "/other"), tmp_path)
    assert there.take("a")
    assert (here.alive(), there.alive()) == (0, 1)
    here.close()
    there.close()


def test_nobody_waits_without_limit_for_others_who_wait_for_the_database(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jobs.lease._TURN_S", 0.1)
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


def test_everything_asked_of_the_queue_fails_at_once_while_the_database_is_away(server: Server) -> None:
    engine = Engine(server.url)
    engine.enqueue("a", 10)
    questions: list[Callable[[], object]] = [
        lambda: engine.enqueue("b", 10),
        lambda: engine.entries(["a"]),
        engine.running,
        engine.waiting,
        lambda: engine.cancel("a"),
        lambda: engine.requeue(["a"]),
        lambda: engine.rewind("a"),
        lambda: engine.delete("a"),
    ]
    with ThreadPoolExecutor(len(questions)) as pool, server.away():
        for answer in [pool.submit(question) for question in questions]:
            with pytest.raises(JobError, match="does not answer"):
                answer.result(10)
    assert engine.entries(["a", "b"]).keys() == {"a"}
    engine.delete("a")
    engine.close()


def test_a_worker_goes_on_when_the_database_is_back_and_leaves_while_it_is_away(server: Server, tmp_path: Path) -> None:
    engine, looker = Engine(server.url), open_leases(server.url, tmp_path)
    jobs = JobQueue(Store(tmp_path / "data"), engine)
    job_id = submit(jobs, ENDLESS)
    folder = jobs.store.folder(job_id)
    with working(jobs, server.url) as worker:
        until(lambda: folder.checkpoint())
        with server.away():
            reached = folder.checkpoint() or 0
            time.sleep(3.0)  # longer than a round of the worker
            until(lambda: (folder.checkpoint() or 0) > reached)
        until(lambda: looker.alive() == 1)
        assert jobs.get(job_id).state is JobState.RUNNING
        assert len(folder.attempts()) == 1
        with server.away():
            worker.terminate()
            assert worker.wait(60) == 0
            assert resting(jobs, job_id)
    assert looker.alive() == 0
    with working(jobs, server.url):  # takes the job of the one that could not give it back
        until(lambda: len(folder.attempts()) == 2)
        jobs.cancel(job_id)
        until(lambda: resting(jobs, job_id))
    looker.close()
    engine.close()


def test_a_job_outlives_kill_9_of_its_worker(url: str, tmp_path: Path) -> None:
    engine = Engine(url)
    jobs = JobQueue(Store(tmp_path / "data"), engine)
    job_id = submit(jobs, ENDLESS)
    folder = jobs.store.folder(job_id)
    with working(jobs, url) as first, working(jobs, url) as second:
        until(lambda: folder.checkpoint())
        owner = folder.attempts()[0].worker
        next(one for one in (first, second) if f"-{one.pid}-" in owner).send_signal(signal.SIGKILL)
        until(lambda: len(folder.attempts()) == 2)
        taken_over = folder.attempts()[1]
        assert taken_over.worker != owner
        until(lambda: (folder.checkpoint() or 0) > taken_over.checkpoint > 0)
        assert jobs.cancel(job_id).state is JobState.CANCELLED
        until(lambda: resting(jobs, job_id))
    engine.close()
