"""Schemas: the resources of the service."""

from __future__ import annotations

from datetime import datetime
from time import time
from typing import Any

from pydantic import BaseModel, Field

from jobs.job import Job, JobState
from jobs.progress import ProgressReport
from service.access import Caller


class JobSummary(BaseModel):
    """A training job as it is listed."""

    id: str = Field(description="Identifies the job in all addresses.")
    name: str = Field(description="Name given by its author.")
    state: JobState = Field(description="Where the job is in its life.")
    priority: int = Field(description="Jobs with a lower number start first.")
    created_at: datetime = Field(description="When it was submitted.")
    started_at: datetime | None = Field(description="When its trainer was first started; null before.")
    finished_at: datetime | None = Field(description="When it ended; null before.")
    queued_s: float = Field(description="Seconds from its submission to its first start, or until now or its end.")
    attempts: int = Field(description="How often the trainer was started.")
    progress: ProgressReport | None = Field(description="The trainer's last report; null before the first.")
    checkpoint: int | None = Field(description="Iteration of the newest checkpoint, which `/render` shows.")
    error: str | None = Field(description="Why the job failed or diverged, with a remedy; null otherwise.")
    links: dict[str, str] = Field(description="Addresses of what can be done with the job or read of it now.")


class JobResource(JobSummary):
    """A training job."""

    capture: str = Field(description="sha256 of the uploaded archive.")
    webhook: str | None = Field(
        description="Address that is told what happens to the job; null for who may only look at the job."
    )
    webhook_secret: str | None = Field(None, description="Verifies its messages; only in the answer to the submission.")
    config: dict[str, Any] = Field(description="All options of the run; `GET /options` has their schema.")


class JobPage(BaseModel):
    """Some jobs, newest first."""

    jobs: list[JobSummary] = Field(description="The jobs of this page, without their options.")
    next: str | None = Field(description="Address of the next page; null on the last.")


class SceneOption(BaseModel):
    """A synthetic scene that `graings synthesize` writes as a capture."""

    name: str = Field(description="The scene's name.")
    question: str = Field(description="What the scene tests.")


class OptionsResource(BaseModel):
    """What a submitter can choose."""

    options: dict[str, Any] = Field(
        alias="schema", description="JSON Schema of every training option with default, bounds and description."
    )
    presets: dict[str, dict[str, Any]] = Field(description="All values of each preset.")
    scenes: list[SceneOption] = Field(description="Synthetic scenes to try without a capture of one's own.")


class Readiness(BaseModel):
    """Whether the service can take work."""

    ready: bool = Field(description="Whether a job can be submitted.")
    workers: int = Field(description="Live workers. Jobs can be submitted without one, but wait for one.")
    waiting: int = Field(description="Jobs that wait for a worker.")
    free_mb: int = Field(description="Free space in the data folder, in MB.")


def job_resource(job: Job, caller: Caller) -> JobResource:
    """The resource of a job, as the caller may see it: the address of a webhook is often a secret by itself."""
    webhook = job.spec.webhook if caller.may_change else None
    return JobResource(**dict(job_summary(job)), capture=job.spec.capture, webhook=webhook, config=job.spec.config)


def job_summary(job: Job) -> JobSummary:
    """The entry of a job in a list."""
    base = f"/jobs/{job.id}"
    links = {"self": base, "events": f"{base}/events", "log": f"{base}/log"}
    if job.state in (JobState.QUEUED, JobState.RUNNING):
        links["cancel"] = f"{base}/cancel"
    elif job.state is JobState.CANCELLED:
        links["resume"] = f"{base}/resume"
    elif job.state is JobState.SUCCEEDED:
        links["extend"] = f"{base}/extend"
    else:
        links["retry"] = f"{base}/retry"
    if job.checkpoint is not None or job.has_model:
        links |= {"render": f"/render?job={job.id}", "export": f"{base}/export?format=ply"}
        links["views"] = f"{base}/views"
        links["scene"] = f"{base}/scene" + ("" if job.checkpoint is None else f"?checkpoint={job.checkpoint}")
        links |= {"comparison": f"{base}/comparison", "videos": f"{base}/videos", "tasks": f"{base}/tasks"}
        if job.state.final:
            links["evaluate"] = f"{base}/evaluate"
    if job.has_plan:
        links["plan"] = f"{base}/plan"
    if job.has_metrics:
        links |= {"metrics": f"{base}/metrics", "report": f"{base}/report"}
    if job.has_curve:  # training draws it less often than it writes metrics
        links["curve"] = f"{base}/curve.svg"
    if job.has_model:
        links["model"] = f"{base}/model"
    same = ("id", "state", "created_at", "started_at", "finished_at", "attempts", "progress", "checkpoint", "error")
    values: dict[str, Any] = {name: getattr(job, name) for name in same}
    queued_s = (job.started_at or job.finished_at or time()) - job.created_at
    return JobSummary(**values, name=job.spec.name, priority=job.spec.priority, queued_s=queued_s, links=links)
