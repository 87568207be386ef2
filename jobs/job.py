"""Job: one training run in the queue, and its states.

                 ┌──────── resume ────────┐
                 ▼                        │
    ─ submit ▶ queued ─── cancel ──▶ cancelled
               │  ▲ ▲                     ▲
        a worker  │ │ its worker died     │
        takes it  │ │ or was stopped      │
               ▼  │ │                     │
             running ───── cancel ────────┘
               │  │
               │  └──────▶ failed, diverged ── retry ──▶ queued
               ▼
           succeeded ── extend ──▶ queued

The last checkpoint is always kept, and a job that is queued again continues from it.
"""

from __future__ import annotations

import re
import uuid
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

from jobs.progress import ProgressReport

ID_PATTERN = r"^[0-9a-f]{16}$"
_ID = re.compile(ID_PATTERN)


class JobState(StrEnum):
    """The state of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    DIVERGED = "diverged"

    @property
    def final(self) -> bool:
        """Whether the job stays in this state until a client changes it."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


class JobError(Exception):
    """Base class of the errors of jobs; each message names the job and a remedy."""


class JobNotFound(JobError):
    """There is no such job."""

    def __init__(self, job_id: str) -> None:
        super().__init__(f"There is no job {job_id!r}. The list of jobs has every id.")


class CaptureNotFound(JobError):
    """No job has such a capture."""

    def __init__(self, digest: str) -> None:
        super().__init__(f"There is no capture {digest!r}: a capture is kept while a job uses it. Send it again.")


class JobDamaged(JobError):
    """A file of the job cannot be read."""


class JobConflict(JobError):
    """The job's state does not allow the request."""


class OtherSubmission(JobError):
    """The key of a submission was used for another one."""


@dataclass(frozen=True, slots=True)
class JobSpec:
    """A submitted job. `capture` is the SHA-256 of the uploaded archive, `config` a whole `TrainConfig` as JSON.

    Jobs with a lower `priority` start first. `owner` is the key that submitted it; None for nobody's.
    `webhook` is the address that is told what happens to it, with a secret to sign that.
    """

    name: str
    capture: str
    config: dict[str, Any]
    priority: int = 10
    owner: str | None = None
    webhook: str | None = None
    webhook_secret: str | None = None

    def trained_for(self, iterations: int) -> JobSpec:
        """The same with so many iterations in all."""
        return replace(self, config={**self.config, "iterations": iterations})


@dataclass(frozen=True, slots=True)
class Attempt:
    """One start of the trainer. `checkpoint` is the iteration it continued from (0: from the beginning).

    `exit_code` is None while it runs, and stays None when its worker dies. `final` marks the attempts of a job that
    ended, so that a retry does not count them. Times are Unix seconds.
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
    """A job with its state, as clients see it.

    Times are Unix seconds, `progress` is the trainer's last report as JSON, `checkpoint` is the iteration of the newest
    checkpoint.
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
    has_curve: bool
    has_plan: bool
    has_model: bool
    error: str | None


def is_id(name: str) -> bool:
    """Whether `name` has the form of a job id."""
    return _ID.fullmatch(name) is not None


def new_id(now: float) -> str:
    """An id that begins with the time `now` (Unix seconds), so that ids sort by age."""
    return f"{int(now * 1000):011x}{uuid.uuid4().hex[:5]}"


def check_id(job_id: str) -> str:
    """`job_id` itself, checked to have the form of an id and so to be safe in a path. Raises `JobNotFound`."""
    if not is_id(job_id):
        raise JobNotFound(job_id)
    return job_id
