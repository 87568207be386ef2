"""Real workers, real trainers, real signals, on a capture of a few small images."""

from __future__ import annotations

import asyncio
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from graings.storage.locks import locked
from jobs.child_process import ChildProcess, ProcessExit, _lower_priority
from jobs.commands import TRAINING_NICE
from jobs.exit_code import ExitCode
from jobs.job import Attempt, JobConflict, JobError, JobSpec, JobState
from jobs.queue import JobQueue
from jobs.worker import MAX_CRASHES, MAX_WORKER_DEATHS, Worker, give_up_reason

LONG_S = 120.0
# Long enough to be interrupted, with a checkpoint every 20 iterations.
ENDLESS = {"iterations": 100_000, "init.points": 300, "evaluation.checkpoint_every": 20, "evaluation.first": 99_000}
BRIEF = {"iterations": 30, "init.points": 300, "evaluation.views": 1}


def submit(jobs: JobQueue, options: dict[str, object], name: str = "job") -> str:
    unpacked = write_synthetic(jobs.store.uploads / name, frames=6, size=24)
    config = make_config("draft", options).model_dump(mode="json")
    return jobs.submit(JobSpec(name=name, capture=f"{name:0<64}", config=config), unpacked).id


@contextmanager
def working(jobs: JobQueue, url: str | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """A worker process; interrupted at the end unless it has ended by then."""
    command = [sys.executable, "-m", "jobs.commands", "--data", str(jobs.store.root), "--threads", "1"]
    command += [] if url is None else ["--database", url]
    with subprocess.Popen(command) as process:
        try:
            yield process
        finally:
            process.terminate()


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < deadline, f"not reached within {LONG_S:g} s"
        time.sleep(0.1)


def thread_priorities(worker: int, module: str) -> list[int]:
    """Nice values of all threads of the worker's children that run `module`; Linux only."""
    threads = [int(task.name) for pid in children(worker, module) for task in Path(f"/proc/{pid}/task").iterdir()]
    return [os.getpriority(os.PRIO_PROCESS, thread) for thread in threads]


def session_priorities(worker: int, module: str) -> list[int]:
    """Nice values of the scheduling groups of the children's sessions; empty where the kernel has no such groups."""
    files = [Path(f"/proc/{pid}/autogroup") for pid in children(worker, module)]
    return [int(file.read_text().split()[-1]) for file in files if file.exists()]


def children(worker: int, module: str) -> list[int]:
    files = Path(f"/proc/{worker}/task").glob("*/children")
    pids = [int(pid) for file in files for pid in file.read_text().split()]
    return [pid for pid in pids if module in Path(f"/proc/{pid}/cmdline").read_text()]


def is_idle(jobs: JobQueue, job_id: str) -> bool:
    """Whether no trainer holds the job's folder."""
    with locked(jobs.store.folder(job_id).lock, wait=False) as free:
        return free


@pytest.mark.slow(reason="two workers and two trainers, processes of their own")
def test_another_worker_continues_the_job_of_a_killed_one_and_returns_it_to_the_queue_when_stopped(
    jobs: JobQueue,
) -> None:
    job_id = submit(jobs, ENDLESS)
    folder = jobs.store.folder(job_id)
    with working(jobs) as first:
        until(lambda: folder.checkpoint())
        lowered = min(19, os.getpriority(os.PRIO_PROCESS, 0) + TRAINING_NICE)
        assert set(thread_priorities(first.pid, "jobs.trainer_process")) == {lowered}
        assert set(session_priorities(first.pid, "jobs.trainer_process")) <= {lowered}
        first.send_signal(signal.SIGKILL)
        first.wait()
        reached = folder.checkpoint() or 0
        assert jobs.get(job_id).state is JobState.RUNNING  # no other worker has noticed yet
    with working(jobs) as second:
        until(lambda: jobs.get(job_id).attempts == 2)
        killed, taken_over = folder.attempts()
        assert killed.exit_code is None
        assert killed.worker != taken_over.worker
        assert taken_over.checkpoint >= reached > 0
        # The first trainer noticed that its worker ended and stopped at a checkpoint, from which the new one continues.
        until(lambda: (folder.checkpoint() or 0) > taken_over.checkpoint)
        second.terminate()
        assert second.wait(LONG_S) == 0
    job = jobs.get(job_id)
    assert (job.state, is_idle(jobs, job_id)) == (JobState.QUEUED, True)
    assert folder.attempts()[-1].exit_code == ExitCode.STOPPED
    assert job.progress is not None
    assert job.checkpoint is not None
    assert job.checkpoint >= job.progress.iteration
    assert list(jobs.store.workers.iterdir()) == []


@pytest.mark.slow(reason="seven processes that train")
def test_jobs_are_cancelled_resumed_retried_and_finished(jobs: JobQueue) -> None:
    endless, brief = submit(jobs, ENDLESS, "a"), submit(jobs, BRIEF, "b")
    broken = submit(jobs, BRIEF, "c")
    (jobs.store.capture(f"{'c':0<64}") / "transforms_train.json").write_text("{}")
    with working(jobs):
        until(lambda: jobs.store.folder(endless).checkpoint())
        with pytest.raises(JobConflict, match="Cancel it first"):
            jobs.delete(endless)
        assert jobs.cancel(endless).state is JobState.CANCELLED
        assert jobs.cancel(endless).state is JobState.CANCELLED
        with pytest.raises(JobConflict, match="Use resume"):
            jobs.retry(endless)
        until(lambda: jobs.get(brief).state.final and jobs.get(broken).state.final)
        assert is_idle(jobs, endless)

        done = jobs.get(brief)
        assert (done.state, done.error, done.checkpoint) == (JobState.SUCCEEDED, None, 30)
        assert done.has_metrics
        for refused in (jobs.cancel, jobs.resume, jobs.retry):
            with pytest.raises(JobConflict):
                refused(brief)

        failed = jobs.get(broken)
        assert failed.state is JobState.FAILED
        assert failed.attempts == 1  # trying again would not help
        assert "transforms_train.json" in (failed.error or "")
        with pytest.raises(JobConflict, match="Use retry"):
            jobs.resume(broken)
        jobs.retry(broken)
        until(lambda: jobs.get(broken).attempts == 2 and jobs.get(broken).state.final)

        reached = jobs.get(endless).checkpoint or 0
        jobs.resume(endless)
        until(lambda: (jobs.get(endless).checkpoint or 0) > reached)
        # Cancelled and resumed before the worker notices: there is still only one trainer, and it continues.
        jobs.cancel(endless)
        jobs.resume(endless)
        until(lambda: jobs.get(endless).attempts == 3)
        assert jobs.store.folder(endless).attempts()[-1].checkpoint > reached
        jobs.cancel(endless)
    jobs.delete(endless)
    assert [job.id for job in jobs.page(10)[0]] == [broken, brief]


def test_the_priority_of_a_child_that_has_ended_already_stays() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    _lower_priority(process.pid, 1)  # raises nothing: the job would fail


@pytest.mark.slow(reason="waits until a worker is sure that it has forgotten a job")
def test_a_job_whose_end_could_not_be_recorded_ends_once_it_can_be(jobs: JobQueue) -> None:
    def change(statement: str) -> None:
        with closing(sqlite3.connect(jobs.store.root / "jobs.sqlite", timeout=30)) as database, database:
            database.execute(statement)

    ended = "new.status in ('SUCCESS', 'ERROR')"  # as on a full disk
    change(f"create trigger full before update on workflow_status when {ended} begin select raise(abort, 'full'); end")
    job_id = submit(jobs, BRIEF)
    with working(jobs):
        until(lambda: jobs.get(job_id).attempts and jobs.store.folder(job_id).attempts()[-1].final)
        change("drop trigger full")
        assert jobs.get(job_id).state is JobState.RUNNING
        until(lambda: jobs.get(job_id).state is JobState.SUCCEEDED)


SLEEP = "import time; time.sleep(60)"
DEAF = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); {SLEEP}"


@pytest.mark.parametrize(("statement", "code"), [(SLEEP, -signal.SIGTERM), (DEAF, -signal.SIGKILL)])
def test_a_stop_that_ends_the_trainer_by_a_signal_is_no_crash(
    jobs: JobQueue, monkeypatch: pytest.MonkeyPatch, statement: str, code: int
) -> None:
    """It may be importing, or be busy for longer than its grace time."""
    unpacked = jobs.store.uploads / "u"
    unpacked.mkdir()
    (unpacked / "a.json").write_text("")
    folder = jobs.store.folder(jobs.submit(JobSpec("job", "0" * 64, {}), unpacked).id)
    worker = Worker(jobs.store, "")
    worker._queue = jobs
    endings: list[int] = []

    class Trainer(ChildProcess):
        async def run(self) -> ProcessExit:
            ending = await super().run()
            endings.append(ending.code)
            return ending

    def child(*_: object) -> ChildProcess:
        return Trainer(["timeit", "-n", "1", "-r", "1", statement], folder.log, grace_s=0.1)

    async def stop_while_it_works() -> None:
        work = asyncio.create_task(worker._work(folder.path.name))
        await asyncio.sleep(1.0 if statement is SLEEP else 3.0)
        worker._trainers[folder.path.name].stop()
        with pytest.raises(JobError, match="was taken from worker"):
            await work

    monkeypatch.setattr(worker, "_child", child)
    for _ in range(MAX_CRASHES + 1):
        asyncio.run(stop_while_it_works())
    assert endings == [code] * (MAX_CRASHES + 1)
    assert {attempt.exit_code for attempt in folder.attempts()} == {ExitCode.STOPPED}
    assert give_up_reason(folder.attempts(), 0) is None


def attempts(*exit_codes: int | None, checkpoint: int = 0, final: bool = False) -> list[Attempt]:
    return [Attempt(i, "w", 0.0, checkpoint, None, code, None, final) for i, code in enumerate(exit_codes, start=1)]


def test_a_job_fails_when_attempts_in_a_row_fail_at_the_same_checkpoint() -> None:
    assert give_up_reason(attempts(*[1] * (MAX_CRASHES - 1)), 0) is None
    assert "exit code 1" in (give_up_reason(attempts(*[1] * MAX_CRASHES), 0) or "")
    assert "memory" in (give_up_reason(attempts(*[-9] * MAX_CRASHES), 0) or "")
    assert "worker died" in (give_up_reason(attempts(*[None] * MAX_WORKER_DEATHS), 0) or "")


def test_progress_a_requested_stop_and_a_retry_reset_the_count_of_failures() -> None:
    assert give_up_reason(attempts(*[1] * 9, checkpoint=100), 200) is None
    assert give_up_reason(attempts(*[ExitCode.STOPPED] * 99), 0) is None
    assert give_up_reason(attempts(*[1] * 9, final=True), 0) is None
