"""Job: one training run that somebody asked for.

                 ┌──────── resume ────────┐
                 ▼                        │
    ─ submit ▶ queued ─── cancel ──▶ cancelled
               │  ▲ ▲                     ▲
        a worker  │ │ its worker died     │
        takes it  │ │ or left             │
               ▼  │ │                     │
             running ───── cancel ────────┘
               │  │
               │  └──────▶ failed, diverged ── retry ──▶ queued
               ▼
           succeeded

Whatever happens the last checkpoint is kept, and a job that is queued again continues from it. Plain data: knows
nothing of files, databases or HTTP.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from jobs.progress import ProgressReport

ID_PATTERN = r"^[0-9a-f]{16}$"
_ID = re.compile(ID_PATTERN)


class JobState(StrEnum):
    """Where a job is in its life."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    DIVERGED = "diverged"

    @property
    def final(self) -> bool:
        """Whether nothing more happens to the job by itself."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


class JobError(Exception):
    """Root of what can go wrong with a job; each message names the job and a remedy."""


class JobNotFound(JobError):
    """There is no such job."""

    def __init__(self, job_id: str) -> None:
        super().__init__(f"There is no job {job_id!r}. The list of jobs has every id.")


class JobDamaged(JobError):
    """What is stored of a job cannot be read."""


class JobConflict(JobError):
    """The job's state forbids what was asked of it."""


@dataclass(frozen=True, slots=True)
class JobSpec:
    """What was asked for. `capture` is the sha256 of the uploaded archive, `config` a whole `TrainConfig` as JSON.

    Jobs with a lower `priority` start first.
    """

    name: str
    capture: str
    config: dict[str, Any]
    priority: int = 10


@dataclass(frozen=True, slots=True)
class Attempt:
    """One start of the trainer. `checkpoint` is the iteration it continued from (0: from the beginning).

    `exit_code` is null while it runs, and stays null when its worker died with it. `final` marks an attempt after
    which the job ended, so that a retry starts counting anew. Times are Unix seconds.
    """

    number: int
    worker: str
    started_at: float
    checkpoint: int
    ended_at: float | None = None
    exit_code: int | None = None
    message: str | None = None
    final: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a job ended: succeeded, failed or diverged, and why."""

    state: JobState
    error: str | None = None


@dataclass(frozen=True, slots=True)
class Job:
    """A job as a front end sees it. Times are Unix seconds; `progress` is the trainer's last report.

    `checkpoint` is the iteration of the newest one.
    """

    id: str
    spec: JobSpec
    state: JobState
    created_at: float
    started_at: float | None
    finished_at: float | None
    attempts: int
    progress: ProgressReport | None
    checkpoint: int | None
    has_metrics: bool
    has_model: bool
    error: str | None


def is_id(name: str) -> bool:
    """Whether this has the form of an id."""
    return _ID.fullmatch(name) is not None


def check_id(job_id: str) -> str:
    """The id itself when it has the form of one, so that it is safe in a path. Raises `JobNotFound`."""
    if not is_id(job_id):
        raise JobNotFound(job_id)
    return job_id
