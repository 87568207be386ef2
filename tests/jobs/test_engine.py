"""The queue on a real SQLite database. DBOS allows one worker per process, so these tests run one after the other."""

from __future__ import annotations

import asyncio
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest

from jobs.engine import Engine, executing
from jobs.job import JobConflict, JobSpec, JobState, Outcome
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
        assert time.monotonic() < deadline, f"not reached within {LONG_S:g} s"
        time.sleep(0.05)


def deliver(*_: object) -> None:
    raise AssertionError("no message was sent")


async def do_task(*_: object) -> Outcome:
    raise AssertionError("no task was enqueued")


def state(engine: Engine, job_id: str) -> JobState:
    return engine.entries([job_id])[job_id].state


def test_the_database_keeps_a_write_ahead_log(tmp_path: Path, engine: Engine) -> None:
    engine.enqueue("a", 10)
    assert (tmp_path / "jobs.sqlite-wal").exists()


def test_jobs_run_by_priority_and_end_with_their_outcome(engine: Engine) -> None:
    order: list[str] = []

    async def run(job_id: str) -> Outcome:
        order.append(job_id)
        if job_id == "broken":
            raise ValueError("unexpected")
        return Outcome(JobState(job_id), f"because {job_id}")

    for job_id, priority in (("diverged", 30), ("failed", 20), ("broken", 15), ("succeeded", 10)):
        engine.enqueue(job_id, priority)
    assert engine.waiting() == 4
    with executing(engine.url, "worker-a", 1, run, deliver, do_task):
        until(lambda: engine.waiting() == 0 and not engine.running())
    assert order == ["succeeded", "broken", "failed", "diverged"]
    entries = engine.entries(order)
    assert {job_id: entries[job_id].state.value for job_id in order} == {
        "succeeded": "succeeded", "failed": "failed", "diverged": "diverged", "broken": "failed",
    }  # fmt: skip
    assert entries["failed"].error == "because failed"
    assert "unexpected" in (entries["broken"].error or "")


@pytest.mark.slow(reason="waits for the polls of a queue")
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
    with executing(engine.url, "worker-a", 1, run, deliver, do_task):
        until(lambda: running == ["a"])
        engine.enqueue("b", 10)
        engine.cancel("a")
        assert state(engine, "a") is JobState.CANCELLED
        until(lambda: running == ["b"])
        assert cancelled == ["a"]
        # Back in the queue, it waits until b is done: the limit is one job at a time.
        engine.requeue(["a"])
        time.sleep(1.5)
        assert state(engine, "a") is JobState.QUEUED
        finish = True
        until(lambda: state(engine, "a") is state(engine, "b") is JobState.FAILED)
        engine.rewind("a")
        until(lambda: state(engine, "a") is JobState.FAILED)
    assert most == 1


@pytest.mark.slow(reason="waits for the polls of a queue")
def test_a_job_that_is_taken_again_while_its_last_run_stops_is_running_work_until_both_end(engine: Engine) -> None:
    began: list[int] = []
    ended: list[int] = []
    stop_first = False

    async def run(_: str) -> Outcome:
        began.append(number := len(began))
        try:
            await asyncio.Event().wait()
        finally:
            while number == 0 and not stop_first:  # its trainer writes a checkpoint
                await asyncio.sleep(0.02)
            ended.append(number)
        raise AssertionError("unreachable: only cancellation ends the wait")

    engine.enqueue("a", 10)
    with executing(engine.url, "worker-a", 2, run, deliver, do_task) as running_work:
        until(lambda: began == [0])
        engine.cancel("a")
        time.sleep(2.5)  # the run is cancelled within two seconds
        engine.requeue(["a"])
        until(lambda: began == [0, 1])
        stop_first = True
        until(lambda: ended == [0])
        time.sleep(0.2)
        assert running_work.ids() == {"a"}
        assert state(engine, "a") is JobState.RUNNING


def test_the_end_of_a_worker_stops_its_job_and_another_worker_can_take_it(engine: Engine) -> None:
    began = threading.Event()

    async def endless(job_id: str) -> Outcome:
        began.set()
        await asyncio.Event().wait()
        raise AssertionError

    async def brief(job_id: str) -> Outcome:
        return Outcome(JobState.SUCCEEDED)

    engine.enqueue("a", 10)
    with executing(engine.url, "worker-a", 1, endless, deliver, do_task):
        assert began.wait(10)
    assert [(entry.job_id, entry.executor) for entry in engine.running()] == [("a", "worker-a")]
    engine.requeue(["a"])
    with executing(engine.url, "worker-b", 1, brief, deliver, do_task):
        until(lambda: state(engine, "a") is JobState.SUCCEEDED)


def test_a_job_that_has_not_ended_cannot_be_rewound_and_an_unknown_one_can_neither_be_rewound_nor_requeued(
    engine: Engine,
) -> None:
    engine.enqueue("a", 10)
    with pytest.raises(JobConflict, match="changed its state"):
        engine.rewind("a")
    for put_back in (engine.rewind, lambda job_id: engine.requeue(["a", job_id])):
        with pytest.raises(JobConflict, match=r"no entry for job .*b"):
            put_back("b")


def test_concurrent_retries_of_a_job_all_succeed(tmp_path: Path, engine: Engine) -> None:
    async def run(job_id: str) -> Outcome:
        return Outcome(JobState.FAILED, "on purpose")

    jobs = JobQueue(Store(tmp_path / "data"), engine)
    (tmp_path / "capture").mkdir()
    job_id = jobs.submit(JobSpec("a", "0" * 64, {}), tmp_path / "capture").id
    with executing(engine.url, "worker-a", 1, run, deliver, do_task):
        until(lambda: jobs.get(job_id).state is JobState.FAILED)
    together = threading.Barrier(8)

    def retry(_: int) -> JobState:
        together.wait(LONG_S)
        return jobs.retry(job_id).state

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(retry, range(8))) == {JobState.QUEUED}


@pytest.mark.slow(reason="waits for the polls of a queue")
@pytest.mark.parametrize(
    "enqueue", [lambda engine: engine.enqueue("a", 10), lambda engine: engine.enqueue_task("a", "b", "1")]
)
def test_work_whose_end_cannot_be_recorded_is_known_and_can_be_put_back(
    tmp_path: Path, engine: Engine, enqueue: Callable[[Engine], None]
) -> None:
    runs = 0

    async def run(*_: str) -> Outcome:
        nonlocal runs
        runs += 1
        if runs == 1:  # nobody can write from now on, as on a full disk
            refuse("create trigger full before update on workflow_status begin select raise(abort, 'disk full'); end")
        return Outcome(JobState.SUCCEEDED)

    def refuse(statement: str) -> None:
        with closing(sqlite3.connect(tmp_path / "jobs.sqlite", timeout=30)) as database, database:
            database.execute(statement)

    with executing(engine.url, "worker-a", 1, run, deliver, run) as running_work:
        enqueue(engine)
        until(lambda: runs == 1 and not running_work.ids())
        time.sleep(1.0)
        refuse("drop trigger full")
        assert engine.taken() == {"a": "worker-a"}
        assert engine.taken("worker-b") == {}
        engine.put_back(engine.taken("worker-a"))
        until(lambda: state(engine, "a") is JobState.SUCCEEDED)
        assert (runs, engine.taken(), running_work.ids()) == (2, {}, frozenset())
