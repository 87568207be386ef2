"""Worker: takes jobs from the queue and runs a trainer process for each.

It holds a lease as long as it lives, puts the jobs of dead workers back in the queue, and stops a trainer when its job
is cancelled or given to another worker, or when the worker itself is stopped. All results are in the job's files.
"""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import socket
import sys
import threading
import time
from collections.abc import Iterable, Mapping
from typing import Any, NoReturn

from jobs.child_process import GRACE_S, ChildProcess, ProcessExit
from jobs.engine import Engine, executing
from jobs.exit_code import OUT_OF_MEMORY, ExitCode
from jobs.job import Attempt, JobError, JobNotFound, JobState, Outcome
from jobs.lease import Leases, open_leases
from jobs.queue import JobQueue
from jobs.running_work import RunningWork
from jobs.store import JobFolder, Store
from jobs.webhooks import RETRY_AFTER_S, WebhookError, deliver

LOG = logging.getLogger(__name__)

ROUND_S = 2.0
FORGOTTEN_S = 10.0
# Attempts in a row without a new checkpoint: those in which the trainer crashed, and those in which the worker died.
MAX_CRASHES = 2
MAX_WORKER_DEATHS = 5


class Worker:
    """One worker process: `slots` jobs at a time, `threads` CPU threads each, with a priority lowered by `nice`."""

    def __init__(self, store: Store, database_url: str, *, slots: int = 1, threads: int = 1, nice: int = 0) -> None:
        self.id = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(3)}"
        self._store = store
        self._url = database_url
        self._slots = slots
        self._threads = threads
        self._nice = nice
        self._trainers: dict[str, ChildProcess] = {}
        self._told: dict[str, int | None] = {}  # the checkpoint of each trainer that its webhook knows
        self._idle_since: dict[str, float] = {}  # what we have taken and do not work on
        self._stopping = False

    def run(self, stop: threading.Event) -> None:
        """Work until `stop` is set; then stop all trainers at a checkpoint and put their jobs back in the queue.

        If the database does not answer then, this ends the process, because threads of DBOS would keep it alive.
        """
        engine = self._engine = Engine(self._url)
        self._queue = JobQueue(self._store, engine)
        leases = open_leases(self._url, self._store.workers)
        if not leases.acquire(self.id):
            raise JobError(f"The lease of worker {self.id} is held by another process. Start the worker again.")
        try:
            with executing(self._url, self.id, self._slots, self._work, self._deliver, self._do_task) as running_work:
                LOG.info("worker %s takes jobs: %d at a time, %d threads each", self.id, self._slots, self._threads)
                self._supervise(engine, leases, running_work, stop)
                self._stop_all()
            returned = self._return_jobs(engine)
        finally:
            leases.close()
            engine.close()
            LOG.info("worker %s ended", self.id)
        if not returned:
            _end_process()

    def _return_jobs(self, engine: Engine) -> bool:
        """Put our unfinished work back in the queue; False if the database does not answer."""
        try:
            engine.put_back(engine.taken(self.id))
        except JobError as error:
            # The lease ends with this process, so that other workers requeue these jobs as those of a dead worker.
            LOG.warning("worker %s could not return its jobs, other workers will: %s", self.id, error)
            return False
        return True

    def _supervise(self, engine: Engine, leases: Leases, running_work: RunningWork, stop: threading.Event) -> None:
        while True:
            try:
                if not leases.renew(self.id):
                    LOG.error("the lease of worker %s is now held by another process; the worker ends", self.id)
                    return
                # Before the query: the job of a trainer that starts in between is not in its result yet.
                trainers = list(self._trainers.items())
                taken = engine.taken()
                self._tell_checkpoints([job_id for job_id, _ in trainers])
                requeue_work_of_dead_workers(engine, leases, taken, self.id)
                ours = {entry for entry, executor in taken.items() if executor == self.id}
                self._requeue_forgotten(engine, ours - running_work.ids())
                for job_id, trainer in trainers:
                    if taken.get(job_id) != self.id and not trainer.stopping:
                        LOG.warning("job %s was cancelled or given to another worker: stopping its trainer", job_id)
                        trainer.stop()
            except JobError as error:
                # Training goes on while the database does not answer; the next round tries again.
                LOG.warning("worker %s cannot check its jobs: %s", self.id, error)
            except Exception:
                # An unexpected error here must not end the trainings.
                LOG.exception("worker %s failed to check its jobs", self.id)
            if stop.wait(ROUND_S):
                return

    def _requeue_forgotten(self, engine: Engine, idle: set[str]) -> None:
        """Put back what we have taken and do not work on: its end could not be recorded, as on a full disk.

        After a while, because work begins after it is taken, and ends before that is recorded.
        """
        now = time.monotonic()
        self._idle_since = {entry: self._idle_since.get(entry, now) for entry in idle}
        forgotten = [entry for entry, since in self._idle_since.items() if now - since > FORGOTTEN_S]
        if forgotten:
            LOG.warning("the end of %s was not recorded: back in the queue", ", ".join(forgotten))
            engine.put_back(forgotten)

    def _tell(self, job_id: str, event: str, number: int = 0, **changes: Any) -> None:
        """Tell the webhook of a job, if it has one; a database that does not answer must not end the training."""
        try:
            self._queue.tell(job_id, event, number, **changes)
        except JobError as error:
            LOG.warning("job %s: its webhook is not told of %s: %s", job_id, event, error)

    def _tell_checkpoints(self, job_ids: Iterable[str]) -> None:
        for job_id in job_ids:
            newest = self._store.folder(job_id).checkpoint()
            if newest is not None and newest != self._told.get(job_id):
                self._told[job_id] = newest
                self._tell(job_id, "checkpoint", newest)

    def _deliver(self, message_id: str, job_id: str, content: dict[str, Any], attempt: int) -> None:
        """Send a message; if the receiver does not take it, have it sent again later."""
        try:
            spec = self._store.folder(job_id).spec()
            if spec.webhook and spec.webhook_secret:
                deliver(spec.webhook, spec.webhook_secret, message_id, content)
        except JobNotFound:
            return  # deleted meanwhile
        except WebhookError as error:
            again = attempt < len(RETRY_AFTER_S)
            LOG.warning("job %s: webhook, attempt %d: %s%s", job_id, attempt + 1, error, "" if again else "; given up")
            if again:
                self._engine.send(message_id, job_id, content, attempt + 1, RETRY_AFTER_S[attempt])

    def _stop_all(self) -> None:
        self._stopping = True
        for trainer in list(self._trainers.values()):
            trainer.stop()
        deadline = time.monotonic() + GRACE_S + 5.0
        while self._trainers and time.monotonic() < deadline:
            time.sleep(0.05)

    async def _work(self, job_id: str) -> Outcome:
        """Train a job to its end, with another attempt after a crash if that can help."""
        folder = self._store.folder(job_id)
        while not self._stopping:
            reason = give_up_reason(folder.attempts(), folder.checkpoint() or 0)
            if reason is not None:
                folder.close_attempts()
                return await self._ended(job_id, folder.attempts()[-1].number, Outcome(JobState.FAILED, reason))
            attempt = folder.begin_attempt(self.id)
            await asyncio.to_thread(self._tell, job_id, "started", attempt.number)
            LOG.info("job %s: attempt %d from iteration %d", job_id, attempt.number, attempt.checkpoint)
            trainer = self._child("jobs.trainer_process", folder)
            self._told[job_id] = folder.checkpoint()
            try:
                ending = await self._run_trainer(job_id, trainer)
            except asyncio.CancelledError:
                folder.end_attempt(attempt, ExitCode.STOPPED)
                raise
            LOG.info("job %s: attempt %d ended with code %d", job_id, attempt.number, ending.code)
            # A stop that finds the trainer importing, or busy beyond its grace time, ends it by a signal: no crash.
            stopped = trainer.stopping and ending.code < 0
            folder.end_attempt(attempt, ExitCode.STOPPED if stopped else ending.code, ending.message)
            outcome = _outcome(ending)
            if outcome is not None:
                folder.close_attempts()
                return await self._ended(job_id, attempt.number, outcome)
            if trainer.stopping and not self._stopping:
                raise JobError(f"Job {job_id} was taken from worker {self.id}.")
        # The worker is stopping: its job goes back to the queue, without an outcome.
        await asyncio.Event().wait()
        raise AssertionError("unreachable: only cancellation ends the wait")

    async def _do_task(self, job_id: str, number: str) -> Outcome:
        """Evaluate a job or make its video."""
        ending = await self._child("jobs.task_process", self._store.folder(job_id), number).run()
        LOG.info("job %s: task %s ended with code %d", job_id, number, ending.code)
        if ending.code == ExitCode.DONE:
            return Outcome(JobState.SUCCEEDED)
        killed = f"It ended with code {ending.code}, most likely because memory ran out. Ask for a smaller one."
        return Outcome(JobState.FAILED, ending.message or killed)

    def _child(self, module: str, folder: JobFolder, *arguments: str) -> ChildProcess:
        command = [module, str(folder.path), *arguments, "--threads", str(self._threads)]
        return ChildProcess(command, folder.log, nice=self._nice)

    async def _ended(self, job_id: str, number: int, outcome: Outcome) -> Outcome:
        changes = {"state": outcome.state, "error": outcome.error, "finished_at": time.time()}
        await asyncio.to_thread(self._tell, job_id, "ended", number, **changes)
        return outcome

    async def _run_trainer(self, job_id: str, trainer: ChildProcess) -> ProcessExit:
        """Run a trainer, registered so that `_supervise` can stop it."""
        earlier = self._trainers.get(job_id)
        if earlier is not None:
            # The job was cancelled and resumed between two rounds; the new child waits for the old one's file lock.
            earlier.stop()
        self._trainers[job_id] = trainer
        try:
            return await trainer.run()
        finally:
            if self._trainers.get(job_id) is trainer:
                del self._trainers[job_id]


def requeue_work_of_dead_workers(engine: Engine, leases: Leases, taken: Mapping[str, str | None], own: str) -> None:
    """Put jobs, messages and tasks of dead workers back in the queue. Any number of workers may call this at once.

    `taken` is who has taken what, `own` the id of this worker.
    """
    for executor in sorted({executor for executor in taken.values() if executor} - {own}):
        if not leases.acquire_from_dead(executor):
            continue  # alive, or another worker requeues its jobs
        try:
            left = engine.taken(executor)
            engine.put_back(left)
            LOG.warning("worker %s died: back in the queue: %s", executor, ", ".join(left))
        finally:
            leases.release(executor)


def _end_process() -> NoReturn:
    """End with code 0, without waiting for threads.

    DBOS has threads that retry until the database answers and cannot be stopped, and Python would wait for them.
    """
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _outcome(ending: ProcessExit) -> Outcome | None:
    """The outcome of the job after its trainer ended; None if another attempt may help."""
    match ending.code:
        case ExitCode.DONE:
            return Outcome(JobState.SUCCEEDED)
        case ExitCode.REFUSED:
            return Outcome(JobState.FAILED, ending.message)
        case ExitCode.DIVERGED:
            return Outcome(JobState.DIVERGED, ending.message)
    return None


def give_up_reason(attempts: list[Attempt], checkpoint: int) -> str | None:
    """Why the job has failed: too many of its last attempts ended without a new checkpoint. None: try again."""
    crashes: list[Attempt] = []
    worker_deaths = 0
    for attempt in reversed(attempts):
        if attempt.final or attempt.checkpoint != checkpoint:
            break
        if attempt.exit_code is None:
            worker_deaths += 1
        elif attempt.exit_code != ExitCode.STOPPED:
            crashes.append(attempt)
    if len(crashes) >= MAX_CRASHES:
        return _crash_message(crashes[0], len(crashes))
    if worker_deaths >= MAX_WORKER_DEATHS:
        return (
            f"The worker died {worker_deaths} times with this job at iteration {checkpoint}. Check the machine's "
            "memory and the log, then retry."
        )
    return None


def _crash_message(last: Attempt, times: int) -> str:
    code = last.exit_code or 0
    if code in OUT_OF_MEMORY:
        return (
            f"The trainer was killed {times} times after iteration {last.checkpoint}, most likely because memory ran "
            "out. Lower capture.max_side, capture.cache_mb or density.max_anchors, or use a larger machine."
        )
    if last.message is not None:
        return last.message
    cause = f"by signal {-code}" if code < 0 else f"with exit code {code}"
    return f"The trainer ended {times} times {cause} after iteration {last.checkpoint}. The log has the reason."
