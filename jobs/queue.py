"""JobQueue: what a front end may ask of jobs.

Puts together where a job is in the queue (`jobs.engine`) and what there is of it on disk (`jobs.store`), and decides
what its state allows. Holds no state of its own: any number of processes may have one. Knows no HTTP.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from pathlib import Path
from typing import Final

from jobs.engine import Engine, QueueEntry
from jobs.job import Attempt, Job, JobConflict, JobDamaged, JobNotFound, JobSpec, JobState
from jobs.progress import last_progress
from jobs.store import Store

LOG = logging.getLogger(__name__)

_RETRIABLE: Final = (JobState.FAILED, JobState.DIVERGED)

# Stands for what was asked for where that cannot be read.
UNREADABLE_SPEC: Final = JobSpec(name="unreadable", capture="", config={})


class JobQueue:
    """Submit, look at and steer jobs. All methods may block on the disk or the database; all are thread-safe."""

    def __init__(self, store: Store, engine: Engine) -> None:
        self.store = store
        self._engine = engine

    def enqueue_orphans(self) -> None:
        """Queue jobs that were stored but not queued because the process died in between. Call once at the start."""
        ids = self.store.ids()
        known = self._engine.entries(ids)
        for job_id in ids:
            if job_id not in known:
                try:
                    priority = self.store.folder(job_id).spec().priority
                except JobDamaged as error:
                    LOG.warning("%s", error)  # it is listed as failed, with these words
                    continue
                self._engine.enqueue(job_id, priority)

    def submit(self, spec: JobSpec, unpacked: Path) -> Job:
        """A new job on the capture in the folder `unpacked`, which moves into the store."""
        job_id = self.store.create(spec, unpacked)
        try:
            self._engine.enqueue(job_id, spec.priority)
        except BaseException:
            # Who is told that it went wrong will send it again.
            self.store.delete(job_id)
            raise
        return self.get(job_id)

    def get(self, job_id: str) -> Job:
        """Raises `JobNotFound`."""
        return self._job(job_id, self._engine.entries([job_id]).get(job_id))

    def page(self, limit: int, after: str | None = None) -> tuple[list[Job], str | None]:
        """Jobs from the newest on, those older than the id `after`; and the id to go on from, if there are more."""
        ids = [job_id for job_id in self.store.ids() if after is None or job_id < after]
        chosen = ids[:limit]
        entries = self._engine.entries(chosen)
        jobs = []
        for job_id in chosen:
            with suppress(JobNotFound):  # deleted meanwhile
                jobs.append(self._job(job_id, entries.get(job_id)))
        return jobs, (chosen[-1] if len(ids) > limit else None)

    def cancel(self, job_id: str) -> Job:
        """Stop a job that waits or runs; it keeps its checkpoint. A cancelled one stays as it is."""
        job = self.get(job_id)
        if job.state.final and job.state is not JobState.CANCELLED:
            raise JobConflict(f"Job {job_id} has {job.state}; there is nothing to cancel.")
        if not job.state.final:
            self._engine.cancel(job_id)
        return self.get(job_id)

    def resume(self, job_id: str) -> Job:
        """Queue a cancelled job again; it continues from its checkpoint. One that waits or runs stays as it is."""
        job = self.get(job_id)
        if job.state is JobState.CANCELLED:
            self._engine.requeue([job_id])
        elif job.state.final:
            remedy = "It is done." if job.state is JobState.SUCCEEDED else "Use retry."
            raise JobConflict(f"Job {job_id} has {job.state}; only a cancelled job can be resumed. {remedy}")
        return self.get(job_id)

    def retry(self, job_id: str) -> Job:
        """Queue a job that failed or diverged again; it continues from its last checkpoint, if it has one.

        Of several who ask at once all get the job as it is in the queue again. Raises `JobConflict` for a job in
        another state, and for a damaged one that the queue does not know.
        """
        job = self.get(job_id)
        if job.state in _RETRIABLE:
            try:
                self._engine.rewind(job_id)
            except JobConflict:
                # Either somebody else put it back a moment ago, which is what was asked for, or nobody can.
                if self.get(job_id).state in _RETRIABLE:
                    raise
        elif job.state is JobState.CANCELLED:
            raise JobConflict(f"Job {job_id} was cancelled, it did not fail. Use resume.")
        elif job.state is JobState.SUCCEEDED:
            raise JobConflict(f"Job {job_id} has succeeded; there is nothing to retry. Submit a new job.")
        return self.get(job_id)

    def delete(self, job_id: str) -> None:
        """Remove a job and everything it left. Raises `JobConflict` while it runs."""
        job = self.get(job_id)
        if job.state is JobState.RUNNING:
            raise JobConflict(f"Job {job_id} is running. Cancel it first.")
        if job.state is JobState.QUEUED:
            self._engine.cancel(job_id)
        self.store.delete(job_id)
        self._engine.delete(job_id)

    def waiting(self) -> int:
        """How many jobs wait for a worker; also the way to find out whether the database answers."""
        return self._engine.waiting()

    def _job(self, job_id: str, ticket: QueueEntry | None) -> Job:
        folder = self.store.folder(job_id)
        state = JobState.QUEUED if ticket is None else ticket.state
        error = None if ticket is None else ticket.error
        spec, attempts = UNREADABLE_SPEC, list[Attempt]()
        try:
            spec, attempts = folder.spec(), folder.attempts()
        except JobDamaged as damage:
            # One bad file must not hide the other jobs, nor keep anybody from deleting this one.
            state, error = JobState.FAILED if ticket is None else state, str(damage)
        return Job(
            id=job_id,
            spec=spec,
            state=state,
            created_at=folder.created_at(),
            started_at=attempts[0].started_at if attempts else None,
            finished_at=None if ticket is None else ticket.finished_at,
            attempts=attempts[-1].number if attempts else 0,
            progress=last_progress(folder.progress),
            checkpoint=folder.checkpoint(),
            has_metrics=folder.metrics.exists(),
            has_model=folder.model.exists(),
            error=error,
        )
