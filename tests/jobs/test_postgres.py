"""The same queue and leases on a PostgreSQL server that is started for the test, where its programs are installed."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from jobs.engine import Engine
from jobs.job import JobError, JobState
from jobs.lease import PostgresLeases, open_leases
from jobs.queue import JobQueue
from jobs.store import Store
from tests.jobs.test_worker import ENDLESS, resting, submit, until, working

pytestmark = pytest.mark.slow


def _user() -> str | None:
    """Whom the server runs as: it refuses root."""
    return "postgres" if os.geteuid() == 0 else pwd.getpwuid(os.geteuid()).pw_name


class Server:
    """A server of our own, at one address however often it is started."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.url = f"postgresql://grain@127.0.0.1:{self.port}/postgres"
        for parent in (folder, *folder.parents[:2]):
            parent.chmod(0o755)
        self._data = folder / "data"
        self._data.mkdir(mode=0o700)
        shutil.chown(self._data, _user())
        self._run(["initdb", "-D", self._data, "-U", "grain", "-A", "trust", "-N"])
        self.start()

    def start(self) -> None:
        port, folder = str(self.port), f"unix_socket_directories={self._data}"
        command = ["postgres", "-D", self._data, "-p", port, "-c", folder, "-c", "fsync=off"]
        self._process = subprocess.Popen(command, user=_user(), cwd=self._data)
        ready = ["pg_isready", "-h", "127.0.0.1", "-p", port, "-q"]
        until(lambda: subprocess.run(ready, check=False).returncode == 0)

    def stop(self) -> None:
        self._process.send_signal(signal.SIGINT)  # now, and tidily
        self._process.wait()

    def _run(self, command: list[str | Path]) -> None:
        subprocess.run(command, user=_user(), cwd=self._data, check=True)


@contextmanager
def server(folder: Path) -> Iterator[Server]:
    if shutil.which("initdb") is None or shutil.which("postgres") is None:
        pytest.skip("PostgreSQL is not installed")
    place = Server(folder)
    try:
        yield place
    finally:
        place.stop()


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with server(Path(tmp_path_factory.mktemp("postgres"))) as place:
        yield place.url


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


def test_a_database_that_went_and_came_back_is_missed_meanwhile_and_used_again(tmp_path: Path) -> None:
    """Nobody waits for it, and nobody has to be started again."""
    with server(tmp_path) as place:
        engine, leases = Engine(place.url), open_leases(place.url, tmp_path)
        engine.enqueue("a", 10)
        assert leases.alive() == 0
        place.stop()
        with pytest.raises(JobError, match="does not answer"):
            engine.waiting()
        with pytest.raises(JobError, match="does not answer"):
            engine.enqueue("b", 10)
        with pytest.raises(JobError, match="does not answer"):
            leases.alive()
        place.start()
        until(lambda: answers(leases.alive) == 0)
        until(lambda: answers(engine.waiting) == 1)
        engine.close()
        leases.close()


def answers(ask: Callable[[], int]) -> int | None:
    """The answer, None while there is none."""
    try:
        return ask()
    except JobError:
        return None


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
