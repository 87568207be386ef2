"""KnownJobs: what was read of the files of jobs that do not change, so that a list of jobs does not read them again."""

from __future__ import annotations

import os
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

from jobs.engine import QueueEntry
from jobs.job import Job, JobNotFound, JobSpec, JobState
from jobs.store import RUN, JobFolder

LIMIT: Final = 2_000  # jobs
SETTLED_S: Final = 60.0  # after the end of a job; the trainer of a cancelled one still writes its checkpoint


@dataclass(frozen=True, slots=True)
class Stamp:
    """Changes with the entry of a job in the queue, its specification, and the files in its folder and its run."""

    entry: QueueEntry
    spec: JobSpec
    folder_ns: int
    run_ns: int | None


class KnownJobs:
    """The jobs that were asked for last. Thread-safe; other processes may change the files."""

    def __init__(self) -> None:
        self._jobs: OrderedDict[str, tuple[Stamp, Job]] = OrderedDict()
        self._guard = threading.Lock()

    def get(self, job_id: str, stamp: Stamp | None) -> Job | None:
        """The job as it was kept with this stamp."""
        with self._guard:
            known = self._jobs.get(job_id)
        return known[1] if known is not None and known[0] == stamp else None

    def keep(self, job: Job, stamp: Stamp | None) -> None:
        """Keep a job that was read after its stamp was taken; None: it may change without notice and is not kept."""
        with self._guard:
            self._jobs.pop(job.id, None)
            if stamp is not None:
                self._jobs[job.id] = (stamp, job)
            if len(self._jobs) > LIMIT:
                self._jobs.popitem(last=False)


def stamp_of(folder: JobFolder, spec: JobSpec, entry: QueueEntry | None) -> Stamp | None:
    """The stamp of a job; None where a process may be writing into its files, whose folders then keep their times.

    Raises `JobNotFound` if the job was deleted.
    """
    if entry is None or entry.state is JobState.RUNNING:
        return None
    if entry.state.final and time.time() - (entry.finished_at or time.time()) < SETTLED_S:
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
