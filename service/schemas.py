"""Schemas: what the service says about jobs. Knows nothing of how it is found out."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from pydantic import BaseModel, Field, ValidationError

from jobs.job import Job, JobState


class ProgressResource(BaseModel):
    """The trainer's last report."""

    phase: str = Field(description="loading, warmup, joint, static or diverged.")
    iteration: int
    iterations: int
    attempt: int
    loss: float | None = None
    psnr: float | None = Field(None, description="Mean of the training views of the last step, in dB.")
    gaussians: int | None = Field(None, description="Gaussians drawn in any view of the last step.")
    anchors: int | None = None
    iterations_per_s: float | None = None
    eta_s: float | None = Field(None, description="Seconds of training left at this speed.")
    train_s: float | None = Field(None, description="Seconds trained so far, evaluations not counted.")
    held_out_psnr: float | None = Field(None, description="Of the last evaluation of this attempt, in dB.")
    held_out_ssim_3dgs: float | None = None
    events: list[str] = Field([], description="What happened in this step: growth, skipped steps, going back.")


class JobResource(BaseModel):
    """A training job."""

    id: str
    name: str
    state: JobState
    priority: int = Field(description="Jobs with a lower number start first.")
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    attempts: int = Field(description="How often the trainer was started.")
    progress: ProgressResource | None
    checkpoint: int | None = Field(description="Iteration of the newest checkpoint: what would be rendered.")
    error: str | None
    capture: str = Field(description="sha256 of the uploaded archive.")
    config: dict[str, Any]
    links: dict[str, str]


class JobPage(BaseModel):
    """Some jobs, newest first."""

    jobs: list[JobResource]
    next: str | None = Field(description="Address of the next page; null on the last.")


class Readiness(BaseModel):
    """Whether the service can take work."""

    ready: bool
    workers: int = Field(description="Workers alive. None is needed to take jobs; one is needed to do them.")
    waiting: int = Field(description="Jobs that wait for a worker.")
    free_mb: int = Field(description="Free space in the data folder.")


def job_resource(job: Job) -> JobResource:
    """A job as the service shows it."""
    base = f"/jobs/{job.id}"
    links = {"self": base, "events": f"{base}/events", "log": f"{base}/log"}
    if job.state in (JobState.QUEUED, JobState.RUNNING):
        links["cancel"] = f"{base}/cancel"
    elif job.state is JobState.CANCELLED:
        links["resume"] = f"{base}/resume"
    elif job.state is not JobState.SUCCEEDED:
        links["retry"] = f"{base}/retry"
    if job.checkpoint is not None or job.has_model:
        links["render"] = f"/render?job={job.id}"
    if job.has_metrics:
        links |= {"metrics": f"{base}/metrics", "curve": f"{base}/curve.svg", "report": f"{base}/report"}
    if job.has_model:
        links["model"] = f"{base}/model"
    return JobResource(
        id=job.id,
        name=job.spec.name,
        state=job.state,
        priority=job.spec.priority,
        created_at=_moment(job.created_at),
        started_at=None if job.started_at is None else _moment(job.started_at),
        finished_at=None if job.finished_at is None else _moment(job.finished_at),
        attempts=job.attempts,
        progress=None if job.progress is None else _progress(job.progress),
        checkpoint=job.checkpoint,
        error=job.error,
        capture=job.spec.capture,
        config=job.spec.config,
        links=links,
    )


def _progress(report: dict[str, Any]) -> ProgressResource | None:
    """A report as a resource; None for a line that lacks what every report has, until the next one comes."""
    try:
        return ProgressResource.model_validate(report)
    except ValidationError:
        return None


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)
