"""JobQueue: submit, inspect, cancel, resume, retry, extend and delete jobs.

Combines the entry of a job in the queue (`jobs.engine`) with its files on disk (`jobs.store`), and checks which
operations its state allows. It has no state of its own but what it has read: any number of processes may have one.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from time import time
from typing import Any, Final

from graings.config import make_config
from graings.storage.run_folder import CURVE_FILE, METRICS_FILE, MODEL_FILE, PLAN_FILE
from jobs.engine import Engine, QueueEntry
from jobs.job import Attempt, Job, JobConflict, JobDamaged, JobNotFound, JobSpec, JobState
from jobs.known_jobs import KnownJobs, stamp_of
from jobs.progress import last_progress
from jobs.store import JobFolder, Store
from jobs.webhooks import message

LOG = logging.getLogger(__name__)

_RETRIABLE: Final = (JobState.FAILED, JobState.DIVERGED)

# In place of a specification that cannot be read.
UNREADABLE_SPEC: Final = JobSpec(name="unreadable", capture="", config={})


class JobQueue:
    """Operations on jobs. All methods may block on the disk or the database; all are thread-safe."""

    def __init__(self, store: Store, engine: Engine) -> None:
        self.store = store
        self._engine = engine
        self._known = KnownJobs()

    def enqueue_stored_jobs(self) -> None:
        """Enqueue stored jobs that have no entry, because the process died in between. Call once at the start."""
        ids = self.store.ids()
        entries = self._engine.entries(ids)
        for job_id in ids:
            if job_id not in entries:
                try:
                    priority = self.store.folder(job_id).spec().priority
                except JobDamaged as error:
                    LOG.warning("%s", error)  # the job is listed as failed with this message
                    continue
                self._engine.enqueue(job_id, priority)

    def submit(self, spec: JobSpec, unpacked: Path | None, key: str | None = None) -> Job:
        """A new job on the capture in the folder `unpacked`, which is moved into the store; None: on one it has.

        With a `key` that was used before, the job of then.
        """
        job_id = self.store.create(spec, unpacked, key)
        try:
            self._engine.enqueue(job_id, spec.priority)
        except BaseException:
            # The client gets an error and will submit it again; with a key, that only enqueues it.
            if key is None:
                self.store.delete(job_id)
            raise
        return self.get(job_id)

    def get(self, job_id: str) -> Job:
        """Raises `JobNotFound`."""
        return self._job(job_id, self._engine.entries([job_id]).get(job_id))

    def page(
        self,
        limit: int,
        after: str | None = None,
        *,
        wanted: Callable[[str, JobSpec], bool] = lambda job_id, spec: True,
        states: Collection[JobState] = (),
    ) -> tuple[list[Job], str | None]:
        """Jobs older than `after`, newest first, at most `limit`; and the id for the next page, if there may be more.

        Only jobs whose id and specification are `wanted`, in one of `states` unless that is empty. The states are those
        of now; what the files of a job that has ended say may be a second old.
        """
        ids = iter([job_id for job_id in self.store.ids() if after is None or job_id < after])
        jobs: list[Job] = []
        found = ((job_id, spec) for job_id in ids if wanted(job_id, spec := self._listed_spec(job_id)))
        while batch := list(islice(found, limit + 1)):
            entries = self._engine.entries([job_id for job_id, _ in batch])
            for job_id, spec in batch:
                entry = entries.get(job_id)
                with suppress(JobNotFound):  # deleted meanwhile
                    read = None if spec is UNREADABLE_SPEC else spec
                    job = self._known.recent(job_id, entry) or self._job(job_id, entry, read)
                    if not states or job.state in states:
                        jobs.append(job)
            if len(jobs) > limit:
                break
        return jobs[:limit], (jobs[limit - 1].id if len(jobs) > limit else None)

    def spec(self, job_id: str) -> JobSpec:
        """The specification, or `UNREADABLE_SPEC` for a job that is damaged or was deleted."""
        try:
            return self.store.listed_folder(job_id).spec()
        except (JobDamaged, JobNotFound):
            return UNREADABLE_SPEC

    def _listed_spec(self, job_id: str) -> JobSpec:
        return self._known.recent_spec(job_id) or self.spec(job_id)

    def cancel(self, job_id: str) -> Job:
        """Stop a queued or running job; it keeps its checkpoint. A cancelled job does not change."""
        job = self.get(job_id)
        if job.state.final and job.state is not JobState.CANCELLED:
            raise JobConflict(f"Job {job_id} has {job.state}; there is nothing to cancel.")
        if not job.state.final:
            self._engine.cancel(job_id)
            self.tell(job_id, "ended", int(time()))
        return self.get(job_id)

    def resume(self, job_id: str) -> Job:
        """Enqueue a cancelled job again; it continues from its checkpoint. A queued or running job does not change."""
        job = self.get(job_id)
        if job.state is JobState.CANCELLED:
            self._engine.requeue([job_id])
        elif job.state.final:
            remedy = "It is complete." if job.state is JobState.SUCCEEDED else "Use retry."
            raise JobConflict(f"Job {job_id} has {job.state}; only a cancelled job can be resumed. {remedy}")
        return self.get(job_id)

    def retry(self, job_id: str) -> Job:
        """Enqueue a failed or diverged job again; it continues from its last checkpoint, if it has one.

        A queued or running job does not change, so concurrent calls all succeed. Raises `JobConflict` in any other
        state, and for a damaged job that has no entry in the queue.
        """
        job = self.get(job_id)
        if job.state in _RETRIABLE:
            try:
                self._engine.rewind(job_id)
            except JobConflict:
                # A concurrent call may have put it back just before, which is the wanted result.
                if self.get(job_id).state in _RETRIABLE:
                    raise
        elif job.state is JobState.CANCELLED:
            raise JobConflict(f"Job {job_id} was cancelled, it did not fail. Use resume.")
        elif job.state is JobState.SUCCEEDED:
            raise JobConflict(f"Job {job_id} has succeeded; there is nothing to retry. Extend it.")
        return self.get(job_id)

    def extend(self, job_id: str, iterations: int) -> Job:
        """Enqueue a job that has succeeded again, to train for so many more iterations.

        Raises `JobConflict` in any other state, `ConfigError` for more iterations in all than a job may have, and
        `JobDamaged` where the record of its run cannot be read.
        """
        with self.store.changing():  # of two requests at once, one finds the job in the queue
            job = self.get(job_id)
            if job.state is not JobState.SUCCEEDED:
                raise JobConflict(f"Job {job_id} is {job.state}; only one that has succeeded can be extended.")
            folder = self.store.folder(job_id)
            # Counted from the record of the run, which follows the specification when the trainer starts: a process
            # that died between the two writes below has left a longer specification, and the request that repeats it
            # must not extend the job twice.
            longer = job.spec.trained_for(folder.trained_iterations() + iterations)
            make_config(overrides=longer.config)  # raises where the sum is out of range
            folder.write_spec(longer)
            try:
                self._engine.rewind(job_id)
            except BaseException:
                folder.write_spec(job.spec)
                raise
        return self.get(job_id)

    def tell(self, job_id: str, event: str, number: int = 0, **changes: Any) -> None:
        """Send the webhook of a job, if it has one, that something happened; a `number` tells equal events apart.

        `changes` are the fields of the job that the queue does not know yet.
        """
        job = replace(self.get(job_id), **changes)
        if job.spec.webhook is not None:
            self._engine.send(f"{job_id}.{event}.{number}", job_id, message(job, event))

    def delete(self, job_id: str) -> None:
        """Remove a job and all its files. Raises `JobConflict` while it runs."""
        job = self.get(job_id)
        if job.state is JobState.RUNNING:
            raise JobConflict(f"Job {job_id} is running. Cancel it first.")
        if running := self._engine.running_tasks(job_id):
            number = running[0].rpartition(".")[2]
            raise JobConflict(f"Task {number} of job {job_id} is running. Delete that first.")
        if job.state is JobState.QUEUED:
            self._engine.cancel(job_id)
        self.store.delete(job_id)
        self._engine.delete(job_id)

    def waiting(self) -> int:
        """How many jobs wait for a worker. Raises `JobError` if the database does not answer."""
        return self._engine.waiting()

    def _job(self, job_id: str, entry: QueueEntry | None, spec: JobSpec | None = None) -> Job:
        """The job; `spec` is its specification where that was just read."""
        folder = self.store.listed_folder(job_id)
        try:
            spec = spec or folder.spec()
            stamp = stamp_of(folder, spec, entry)
            known = self._known.get(job_id, stamp)
            if known is None:
                known = _read(self.store.folder(job_id), spec, folder.attempts(), entry)
                # A cancelled job that is queued again may still have the trainer of before.
                starts_anew = known.state is JobState.QUEUED and known.attempts > 0
                self._known.keep(known, None if starts_anew else stamp)
            return known
        except JobDamaged as damage:
            # A damaged file must neither hide the other jobs nor prevent the deletion of this one.
            job = _read(folder, UNREADABLE_SPEC, [], entry)
            return replace(job, state=JobState.FAILED if entry is None else job.state, error=str(damage))


def _read(folder: JobFolder, spec: JobSpec, attempts: list[Attempt], entry: QueueEntry | None) -> Job:
    files = folder.run_files()
    return Job(
        id=folder.path.name,
        spec=spec,
        state=JobState.QUEUED if entry is None else entry.state,
        created_at=folder.created_at(),
        started_at=attempts[0].started_at if attempts else None,
        finished_at=None if entry is None else entry.finished_at,
        attempts=attempts[-1].number if attempts else 0,
        progress=last_progress(folder.progress),
        checkpoint=folder.checkpoint() if files else None,
        has_metrics=METRICS_FILE in files,
        has_curve=CURVE_FILE in files,
        has_plan=PLAN_FILE in files,
        has_model=MODEL_FILE in files,
        error=None if entry is None else entry.error,
    )
