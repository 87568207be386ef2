"""The same queue and leases on a PostgreSQL server that is started for the test, where its programs are installed."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from jobs.engine import Engine
from jobs.job import JobState
from jobs.lease import PostgresLeases, open_leases
from jobs.queue import JobQueue
from jobs.store import Store
from tests.jobs.test_worker import ENDLESS, resting, submit, until, working

pytestmark = pytest.mark.slow


def _user() -> str | None:
    """Whom the server runs as: it refuses root."""
    return "postgres" if os.geteuid() == 0 else pwd.getpwuid(os.geteuid()).pw_name


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    if shutil.which("initdb") is None or shutil.which("postgres") is None:
        pytest.skip("PostgreSQL is not installed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    user = _user()
    folder = Path(tmp_path_factory.mktemp("postgres"))
    for parent in (folder, *folder.parents[:2]):
        parent.chmod(0o755)
    data = folder / "data"
    data.mkdir(mode=0o700)
    shutil.chown(data, user)
    subprocess.run(["initdb", "-D", data, "-U", "grain", "-A", "trust", "-N"], user=user, cwd=data, check=True)
    command = ["postgres", "-D", data, "-p", str(port), "-c", f"unix_socket_directories={data}", "-c", "fsync=off"]
    with subprocess.Popen(command, user=user, cwd=data) as server:
        ready = ["pg_isready", "-h", "127.0.0.1", "-p", str(port), "-q"]
        until(lambda: subprocess.run(ready, check=False).returncode == 0)
        yield f"postgresql://grain@127.0.0.1:{port}/postgres"
        server.send_signal(signal.SIGINT)  # end now, and tidily


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
