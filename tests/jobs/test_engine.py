"""The queue on a real SQLite database. One executing process at a time is DBOS's rule, so these tests share theirs."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from sqlalchemy import make_url

from jobs.engine import PATIENCE, Engine, _with_patience, cannot_open, executing, no_answer
from jobs.job import JobConflict, JobError, JobSpec, JobState, Outcome
from jobs.queue import JobQueue
from jobs.store import Store

LONG_S = 20.0


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[Engine]:
    engine = Engine(f"sqlite:///{tmp_path / 'jobs.sqlite'}")
    yield engine
    engine.close()


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)


def state(engine: Engine, job_id: str) -> JobState:
    return engine.entries([job_id])[job_id].state


def test_the_database_keeps_a_write_ahead_log(tmp_path: Path, engine: Engine) -> None:
    engine.enqueue("a", 10)
    assert (tmp_path / "jobs.sqlite-wal").exists()


def test_jobs_run_by_priority_and_end_as_their_outcome_says(engine: Engine) -> None:
    order: list[str] = []

    async def run(job_id: str) -> Outcome:
        order.append(job_id)
        if job_id == "broken":
            raise ValueError("no such luck")
        return Outcome(JobState(job_id), f"because {job_id}")

    for job_id, priority in (("diverged", 30), ("failed", 20), ("broken", 15), ("succeeded", 10)):
        engine.enqueue(job_id, priority)
    assert engine.waiting() == 4
    with executing(engine.url, "worker-a", 1, run):
        until(lambda: engine.waiting() == 0 and not engine.running())
    assert order == ["succeeded", "broken", "failed", "diverged"]
    entries = engine.entries(order)
    assert {one: entries[one].state.value for one in order} == {
        "succeeded": "succeeded", "failed": "failed", "diverged": "diverged", "broken": "failed",
    }  # fmt: skip
    assert entries["failed"].error == "because failed"
    assert "no such luck" in (entries["broken"].error or "")


def test_a_job_can_be_cancelled_requeued_and_rewound_but_runs_under_its_own_limit(engine: Engine) -> None:
    running: list[str] = []
    most = 0
    cancelled: list[str] = []
    finish = False

    async def run(job_id: str) -> Outcome:
        nonlocal most
        running.append(job_id)
        most = max(most, len(running))
        try:
            while not finish:
                await asyncio.sleep(0.02)
        except asyncio.CancelledError:
            cancelled.append(job_id)
            raise
        finally:
            running.remove(job_id)
        return Outcome(JobState.FAILED, "on purpose")

    engine.enqueue("a", 10)
    with executing(engine.url, "worker-a", 1, run):
        until(lambda: running == ["a"])
        engine.enqueue("b", 10)
        engine.cancel("a")
        assert state(engine, "a") is JobState.CANCELLED
        until(lambda: running == ["b"])
        assert cancelled == ["a"]
        # Back in the queue it is bound by the limit of one at a time, which b takes up.
        engine.requeue(["a"])
        time.sleep(1.5)
        assert state(engine, "a") is JobState.QUEUED
        finish = True
        until(lambda: state(engine, "a") is state(engine, "b") is JobState.FAILED)
        engine.rewind("a")
        until(lambda: state(engine, "a") is JobState.FAILED)
    assert most == 1


def test_leaving_stops_what_runs_and_another_worker_can_have_it(engine: Engine) -> None:
    began = threading.Event()

    async def endless(job_id: str) -> Outcome:
        began.set()
        await asyncio.Event().wait()
        raise AssertionError

    async def brief(job_id: str) -> Outcome:
        return Outcome(JobState.SUCCEEDED)

    engine.enqueue("a", 10)
    with executing(engine.url, "worker-a", 1, endless):
        assert began.wait(10)
    assert [(one.job_id, one.executor) for one in engine.running()] == [("a", "worker-a")]
    engine.requeue(["a"])
    with executing(engine.url, "worker-b", 1, brief):
        until(lambda: state(engine, "a") is JobState.SUCCEEDED)


def test_a_database_that_cannot_be_opened_is_named_without_its_password(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="nowhere"):
        Engine(f"sqlite:///{tmp_path}/nowhere/jobs.sqlite")
    with pytest.raises(JobError) as caught:
        Engine("postgresql://me:secret@127.0.0.1:1/none?connect_timeout=1")
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://127.0.0.1:1/none?user=me&password=geheim",
        "postgresql://127.0.0.1:1/none?geheim",
        "postgresql//me:geheim@h",
        "postgresql://me:ge@heim@127.0.0.1:1/none",  # taken for a part of the host
        "postgresql://me:ge/heim@127.0.0.1:1/none",
        "postgresql://me:geheim",  # taken for the port
        "mysql://me:geheim@127.0.0.1:1/none",
        "sqlite://me:geheim@h",
        "geheim",
    ],
)
def test_no_part_of_a_password_is_shown_however_the_url_is_written(url: str) -> None:
    with pytest.raises(JobError, match="cannot be opened") as caught:
        Engine(url)
    assert "heim" not in str(caught.value)


def test_what_a_driver_says_is_shown_without_the_password(caplog: pytest.LogCaptureFixture) -> None:
    error = OSError('password authentication failed for user "me" with ge%heim, ge%25heim\nLINE 1')
    said = str(cannot_open("postgresql://me:ge%25heim@h/none", error))
    assert said.endswith('cannot be opened: password authentication failed for user "me" with …, …')
    assert "h/none" not in said
    said = str(no_answer("postgresql://me@h/none?sslpassword=geheim", OSError("geheim at h is away")))
    assert "away" not in said  # for whoever asks over HTTP
    assert "… at h is away" in caplog.text


def test_waiting_for_a_database_has_limits_which_its_url_can_change() -> None:
    url = make_url(_with_patience("postgresql://me:a%40b@h/none?connect_timeout=9&options=-c%20x%3D1"))
    assert (url.password, url.query["options"]) == ("a@b", "-c x=1")
    assert url.query == {**PATIENCE, "connect_timeout": "9", "options": "-c x=1"}


def test_a_job_that_is_not_at_its_end_or_unknown_cannot_be_rewound_nor_an_unknown_one_requeued(engine: Engine) -> None:
    engine.enqueue("a", 10)
    with pytest.raises(JobConflict, match="changed its state"):
        engine.rewind("a")
    for put_back in (engine.rewind, lambda job_id: engine.requeue(["a", job_id])):
        with pytest.raises(JobConflict, match=r"no entry for job .*b"):
            put_back("b")


def test_of_several_who_retry_a_job_at_once_all_find_it_in_the_queue(tmp_path: Path, engine: Engine) -> None:
    async def run(job_id: str) -> Outcome:
        return Outcome(JobState.FAILED, "on purpose")

    jobs = JobQueue(Store(tmp_path / "data"), engine)
    (tmp_path / "capture").mkdir()
    job_id = jobs.submit(JobSpec("a", "0" * 64, {}), tmp_path / "capture").id
    with executing(engine.url, "worker-a", 1, run):
        until(lambda: jobs.get(job_id).state is JobState.FAILED)
    together = threading.Barrier(8)

    def retry(_: int) -> JobState:
        together.wait(LONG_S)
        return jobs.retry(job_id).state

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(retry, range(8))) == {JobState.QUEUED}
