"""Worker: takes jobs from the queue and has trainer processes do them.

Keeps a lease for as long as it lives, puts the jobs of dead workers back in the queue, and stops its trainers when
their jobs are cancelled, when they are no longer its own, or when it is asked to end. It never trains itself and holds
no truth: that is the checkpoint on disk.
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
from typing import NoReturn

from jobs.engine import Engine, executing
from jobs.exit_code import OUT_OF_MEMORY, ExitCode
from jobs.job import Attempt, JobError, JobState, Outcome
from jobs.lease import Leases, open_leases
from jobs.store import Store
from jobs.trainer_child import GRACE_S, ProcessExit, TrainerChild

LOG = logging.getLogger(__name__)

ROUND_S = 2.0
# Starts that got no further than the one before: crashes of the trainer, and workers that died with it.
MAX_CRASHES = 2
MAX_LOSSES = 5


class Worker:
    """One worker process: `slots` jobs at a time, `threads` CPU threads each."""

    def __init__(self, store: Store, database_url: str, *, slots: int = 1, threads: int = 1) -> None:
        self.id = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(3)}"
        self._store = store
        self._url = database_url
        self._slots = slots
        self._threads = threads
        self._trainers: dict[str, TrainerChild] = {}
        self._leaving = False

    def run(self, stop: threading.Event) -> None:
        """Work until `stop` is set; then bring all trainers to a checkpoint and give their jobs back.

        Where the database is away at that time, this ends the process, as nothing else would.
        """
        engine = Engine(self._url)
        leases = open_leases(self._url, self._store.workers)
        if not leases.take(self.id):
            raise JobError(f"The lease of worker {self.id} is held by another process. Start it again.")
        try:
            with executing(self._url, self.id, self._slots, self._work):
                LOG.info("worker %s takes jobs: %d at a time, %d threads each", self.id, self._slots, self._threads)
                self._rounds(engine, leases, stop)
                self._stop_all()
            returned = self._give_back(engine)
        finally:
            leases.close()
            engine.close()
            LOG.info("worker %s has left", self.id)
        if not returned:
            _end_process()

    def _give_back(self, engine: Engine) -> bool:
        """Put the jobs that were still ours back in the queue; False when the database is away."""
        try:
            engine.requeue([ticket.job_id for ticket in engine.running() if ticket.executor == self.id])
        except JobError as error:
            # The lease goes with us, so that the next worker to look finds them as those of a dead one.
            LOG.warning("worker %s leaves its jobs to others: %s", self.id, error)
            return False
        return True

    def _rounds(self, engine: Engine, leases: Leases, stop: threading.Event) -> None:
        while True:
            try:
                if not leases.keep(self.id):
                    LOG.error("worker %s lost its lease to another process and ends", self.id)
                    return
                # Before asking: a trainer that starts in between belongs to a job not in the answer yet.
                trainers = list(self._trainers.items())
                running = {ticket.job_id: ticket.executor for ticket in engine.running()}
                reap(engine, leases, self.id, running)
                for job_id, trainer in trainers:
                    if running.get(job_id) != self.id and not trainer.stopping:
                        LOG.warning("job %s is no longer ours: stopping its trainer", job_id)
                        trainer.stop()
            except JobError as error:
                # The database may be away for a while; training goes on meanwhile, and the next round asks again.
                LOG.warning("a round of worker %s is put off: %s", self.id, error)
            except Exception:
                # Nobody foresaw it, but it is no reason to give up a training either.
                LOG.exception("a round of worker %s failed", self.id)
            if stop.wait(ROUND_S):
                return

    def _stop_all(self) -> None:
        self._leaving = True
        for trainer in list(self._trainers.values()):
            trainer.stop()
        deadline = time.monotonic() + GRACE_S + 5.0
        while self._trainers and time.monotonic() < deadline:
            time.sleep(0.05)

    async def _work(self, job_id: str) -> Outcome:
        """Train a job to its end, starting over after a crash where that can help."""
        folder = self._store.folder(job_id)
        while not self._leaving:
            reason = give_up_reason(folder.attempts(), folder.checkpoint() or 0)
            if reason is not None:
                folder.close_attempts()
                return Outcome(JobState.FAILED, reason)
            attempt = folder.begin_attempt(self.id)
            LOG.info("job %s: attempt %d from iteration %d", job_id, attempt.number, attempt.checkpoint)
            trainer = TrainerChild(folder, self._threads)
            try:
                ending = await self._owning(job_id, trainer)
            except asyncio.CancelledError:
                folder.end_attempt(attempt, ExitCode.STOPPED)
                raise
            LOG.info("job %s: attempt %d ended with code %d", job_id, attempt.number, ending.code)
            folder.end_attempt(attempt, ending.code, ending.message)
            outcome = _outcome(ending)
            if outcome is not None:
                folder.close_attempts()
                return outcome
            if trainer.stopping and not self._leaving:
                raise JobError(f"Job {job_id} was taken from worker {self.id}.")
        # What becomes of the job is for the next worker to say.
        await asyncio.Event().wait()
        raise AssertionError("unreachable: only cancellation ends the wait")

    async def _owning(self, job_id: str, trainer: TrainerChild) -> ProcessExit:
        """Run a trainer where `_rounds` finds it."""
        earlier = self._trainers.get(job_id)
        if earlier is not None:
            # Cancelled and resumed before we noticed; the new child waits for the old one's lock on the folder.
            earlier.stop()
        self._trainers[job_id] = trainer
        try:
            return await trainer.run()
        finally:
            if self._trainers.get(job_id) is trainer:
                del self._trainers[job_id]


def reap(engine: Engine, leases: Leases, own: str, running: dict[str, str | None]) -> None:
    """Put the jobs of workers that are dead back in the queue. Any number of workers may do so at once."""
    for executor in sorted({other for other in running.values() if other is not None and other != own}):
        if not leases.take_from_the_dead(executor):
            continue  # alive, or somebody else is at it
        try:
            lost = [ticket.job_id for ticket in engine.running() if ticket.executor == executor]
            LOG.warning("worker %s is gone: back in the queue: %s", executor, ", ".join(lost) or "nothing")
            engine.requeue(lost)
        finally:
            leases.release(executor)


def _end_process() -> NoReturn:
    """End with code 0, without waiting for threads.

    DBOS has threads that ask again until the database answers, which nothing stops, and Python waits for them.
    """
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _outcome(ending: ProcessExit) -> Outcome | None:
    """What an ending means for the job; None when another attempt may help."""
    match ending.code:
        case ExitCode.DONE:
            return Outcome(JobState.SUCCEEDED)
        case ExitCode.REFUSED:
            return Outcome(JobState.FAILED, ending.message)
        case ExitCode.DIVERGED:
            return Outcome(JobState.DIVERGED, ending.message)
    return None


def give_up_reason(attempts: list[Attempt], checkpoint: int) -> str | None:
    """Why another attempt would be in vain: too many of the last ones ended badly without getting any further."""
    crashes: list[Attempt] = []
    losses = 0
    for attempt in reversed(attempts):
        if attempt.final or attempt.checkpoint != checkpoint:
            break
        if attempt.exit_code is None:
            losses += 1
        elif attempt.exit_code != ExitCode.STOPPED:
            crashes.append(attempt)
    if len(crashes) >= MAX_CRASHES:
        return _crash_message(crashes[0], len(crashes))
    if losses >= MAX_LOSSES:
        return (
            f"The worker died {losses} times with this job at iteration {checkpoint}. Look at the machine's memory "
            "and at the log, then retry."
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
