"""KnownJobs: what was read of the files of jobs that do not change, so that a list of jobs does not read them again."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from dataclasses import dataclass
from time import monotonic, time
from typing import Final

from jobs.engine import QueueEntry
from jobs.job import Job, JobNotFound, JobSpec, JobState
from jobs.store import RUN, JobFolder

LIMIT: Final = 2_000  # jobs
SETTLED_S: Final = 60.0  # after the end of a job; the trainer of a cancelled one still writes its checkpoint
# A list does not look at the files of an ended job again for so long: each look hands Python to another thread, and
# beside images at work, 150 of them take longer than all the rest of a list of 50 jobs.
RECENT_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class Stamp:
    """Changes with the entry of a job in the queue, its specification, and the files in its folder and its run."""

    entry: QueueEntry
    spec: JobSpec
    folder_ns: int
    run_ns: int | None


@dataclass(slots=True)
class _Known:
    stamp: Stamp
    job: Job
    looked_at: float  # monotonic() when the files had this stamp


class KnownJobs:
    """The jobs that were asked for last. Thread-safe; other processes may change the files."""

    def __init__(self) -> None:
        self._jobs: OrderedDict[str, _Known] = OrderedDict()
        self._guard = threading.Lock()

    def get(self, job_id: str, stamp: Stamp | None) -> Job | None:
        """The job as it was kept with this stamp, which was just taken."""
        with self._guard:
            known = self._jobs.get(job_id)
            if known is None or known.stamp != stamp:
                return None
            known.looked_at = monotonic()
            return known.job

    def recent(self, job_id: str, entry: QueueEntry | None) -> Job | None:
        """The ended job with this entry in the queue, if its files were looked at in the last `RECENT_S`."""
        known = self._recent(job_id)
        return known.job if known is not None and known.stamp.entry == entry else None

    def recent_spec(self, job_id: str) -> JobSpec | None:
        """The specification of the ended job, if its files were looked at in the last `RECENT_S`."""
        known = self._recent(job_id)
        return None if known is None else known.stamp.spec

    def _recent(self, job_id: str) -> _Known | None:
        with self._guard:
            known = self._jobs.get(job_id)
        if known is None or not known.stamp.entry.state.final or monotonic() - known.looked_at >= RECENT_S:
            return None
        return known

    def keep(self, job: Job, stamp: Stamp | None) -> None:
        """Keep a job that was read after its stamp was taken; None: it may change without notice and is not kept."""
        with self._guard:
            self._jobs.pop(job.id, None)
            if stamp is not None:
                self._jobs[job.id] = _Known(stamp, job, monotonic())
            if len(self._jobs) > LIMIT:
                self._jobs.popitem(last=False)


def stamp_of(folder: JobFolder, spec: JobSpec, entry: QueueEntry | None) -> Stamp | None:
    """The stamp of a job; None where a process may be writing into its files, whose folders then keep their times.

    Raises `JobNotFound` if the job was deleted.
    """
    if entry is None or entry.state is JobState.RUNNING:
        return None
    if entry.state.final and time() - (entry.finished_at or time()) < SETTLED_S:
        return None
    path = str(folder.path)
    modified_ns = _modified_ns(path)
    if modified_ns is None:
        raise JobNotFound(folder.path.name)
    return Stamp(entry, spec, modified_ns, _modified_ns(f"{path}/{RUN}"))


def _modified_ns(path: str) -> int | None:
    try:
        return os.stat(path).st_mtime_ns
    except FileNotFoundError:
        return None
