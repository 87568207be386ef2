"""The queue on a real SQLite database. One executing process at a time is DBOS's rule, so these tests share theirs."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from jobs.engine import Engine, executing
from jobs.job import JobConflict, JobError, JobState, Outcome

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
    return engine.tickets([job_id])[job_id].state


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
    tickets = engine.tickets(order)
    assert {one: tickets[one].state.value for one in order} == {
        "succeeded": "succeeded", "failed": "failed", "diverged": "diverged", "broken": "failed",
    }  # fmt: skip
    assert tickets["failed"].error == "because failed"
    assert "no such luck" in (tickets["broken"].error or "")


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


def test_a_database_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="nowhere"):
        Engine(f"sqlite:///{tmp_path}/nowhere/jobs.sqlite")


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://me:secret@127.0.0.1:1/none?connect_timeout=1",
        "postgresql://127.0.0.1:1/none?connect_timeout=1&user=me&password=secret",
        "postgresql//me:secret@127.0.0.1",
        "postgresql://me:other@secret@127.0.0.1:1/none",
        "postgresql://me:other/secret@127.0.0.1:1/none",
    ],
)
def test_a_database_that_cannot_be_opened_is_named_without_its_password_of_any_form(url: str) -> None:
    with pytest.raises(JobError) as caught:
        Engine(url)
    assert "secret" not in str(caught.value)
    assert "other" not in str(caught.value)
    assert "postgresql" in str(caught.value)


def test_who_comes_second_with_a_retry_is_told_so(engine: Engine) -> None:
    async def fail(_: str) -> Outcome:
        return Outcome(JobState.FAILED, "no")

    engine.enqueue("a", 10)
    with executing(engine.url, "worker-a", 1, fail):
        until(lambda: state(engine, "a") is JobState.FAILED)
    engine.rewind("a")
    with pytest.raises(JobConflict, match="queued again meanwhile"):
        engine.rewind("a")
    with pytest.raises(JobConflict, match="submit a new one"):
        engine.rewind("of another queue")
