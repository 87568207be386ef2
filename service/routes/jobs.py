"""Routes of jobs: submit, list, get, cancel, resume, retry, extend, delete. `jobs.queue` implements them."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import urlencode

from anyio import to_thread
from fastapi import APIRouter, Header, Query, Request, Response
from pydantic import HttpUrl

from graings.config import PRESETS, make_config, merged
from jobs.job import ID_PATTERN, Job, JobSpec, JobState
from service.access import Caller, CallerDep
from service.context import ContextDep, JobId
from service.inspection import inspect_capture
from service.problems import RESPONSES
from service.schemas import JobPage, JobResource, job_resource, job_summary
from service.sent_capture import OPTIONAL_BODY, CaptureParam, sent_capture
from service.uploads import parse_config

router = APIRouter(prefix="/jobs", tags=["jobs"], responses=RESPONSES)

RETRY_AFTER_S = "2"


@router.post("", status_code=202, operation_id="submit_job", openapi_extra=OPTIONAL_BODY)
async def submit(
    request: Request,
    response: Response,
    context: ContextDep,
    caller: CallerDep,
    preset: Annotated[str, Query(description=f"Source of default values: {', '.join(PRESETS)}.")] = "standard",
    config: Annotated[
        str | None, Query(description="Options as a JSON object, nested or with dotted keys, see /options.")
    ] = None,
    priority: Annotated[int, Query(ge=1, le=1_000_000, description="Jobs with a lower number start first.")] = 10,
    name: Annotated[
        str | None,
        Query(min_length=1, max_length=120, description="Name of the job, for people (default: `scene` or untitled)."),
    ] = None,
    webhook: Annotated[
        HttpUrl | None, Query(description="Where to POST what happens to the job; signed with its `webhook_secret`.")
    ] = None,
    idempotency_key: Annotated[
        str | None,
        Header(max_length=255, description="Of the client's choice: the same request with it again makes no new job."),
    ] = None,
    capture: CaptureParam = None,
    scene: Annotated[
        str | None,
        Query(max_length=40, description="A synthetic scene of /options, instead of a body: the job draws it first."),
    ] = None,
) -> JobResource:
    """Queue a training job on the capture in the body: an archive, or a multipart form with one as `capture`."""
    overrides = {} if config is None else parse_config(config, "config")
    # Checked before the body is read, so that a typing error is reported before gigabytes are uploaded.
    make_config(preset, overrides)
    title = name or scene or "untitled"
    webhook_address = None if webhook is None else str(webhook)
    async with sent_capture(request, context, caller, capture, scene) as sent:
        chosen = make_config(preset, merged(overrides, sent.config))
        await inspect_capture(sent.folder, chosen.capture)
        spec = JobSpec(title, sent.digest, chosen.model_dump(mode="json"), priority, caller.owner, webhook_address)
        folder = None if sent.stored else sent.folder
        job = await to_thread.run_sync(context.jobs.submit, spec, folder, idempotency_key)
        if sent.upload is not None and not sent.stored:  # once: another job does not put off its expiry
            await to_thread.run_sync(sent.upload.write, sent.digest)
    return _accepted(job, caller, response)


def _accepted(job: Job, caller: Caller, response: Response) -> JobResource:
    response.headers["Location"] = f"/jobs/{job.id}"
    response.headers["Retry-After"] = RETRY_AFTER_S
    return job_resource(job, caller).model_copy(update={"webhook_secret": job.spec.webhook_secret})


@router.get("", operation_id="list_jobs")
def page(
    context: ContextDep,
    caller: CallerDep,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
    cursor: Annotated[str | None, Query(pattern=ID_PATTERN, description="From `next` of the previous page.")] = None,
    state: Annotated[list[JobState], Query(description="Only jobs in one of these states.")] = [],  # noqa: B006
    name: Annotated[str | None, Query(max_length=120, description="Only jobs with this in their name.")] = None,
) -> JobPage:
    """Jobs, newest first."""
    part = (name or "").casefold()

    def wanted(job_id: str, spec: JobSpec) -> bool:
        return part in spec.name.casefold() and caller.sees(job_id, spec)

    jobs, after = context.jobs.page(limit, cursor, wanted=wanted, states=state)
    following = {"limit": limit, "state": state, "name": name or [], "cursor": after}
    return JobPage(jobs=[job_summary(job) for job in jobs], next=after and "/jobs?" + urlencode(following, doseq=True))


@router.get("/{job_id}", operation_id="get_job")
def get(job_id: JobId, response: Response, context: ContextDep, caller: CallerDep) -> JobResource:
    """A job with its state and progress."""
    job = context.jobs.get(job_id)
    if not job.state.final:
        response.headers["Retry-After"] = RETRY_AFTER_S
    return job_resource(job, caller)


@router.post("/{job_id}/cancel", status_code=202, operation_id="cancel_job")
def cancel(job_id: JobId, context: ContextDep, caller: CallerDep) -> JobResource:
    """Stop a job at a checkpoint from which it can be resumed. Cancelling it again changes nothing."""
    return job_resource(context.jobs.cancel(job_id), caller)


@router.post("/{job_id}/resume", status_code=202, operation_id="resume_job")
def resume(job_id: JobId, context: ContextDep, caller: CallerDep) -> JobResource:
    """Queue a cancelled job again; it continues where it stopped. Resuming it again changes nothing."""
    return job_resource(context.jobs.resume(job_id), caller)


@router.post("/{job_id}/retry", status_code=202, operation_id="retry_job")
def retry(job_id: JobId, context: ContextDep, caller: CallerDep) -> JobResource:
    """Queue a failed or diverged job again; it continues from its last checkpoint, if any."""
    return job_resource(context.jobs.retry(job_id), caller)


@router.post("/{job_id}/extend", status_code=202, operation_id="extend_job")
def extend(
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    iterations: Annotated[int, Query(ge=1, le=1_000_000, description="How many more.")],
) -> JobResource:
    """Train a job that has succeeded for more iterations, from its last checkpoint; its model stays until then."""
    return job_resource(context.jobs.extend(job_id, iterations), caller)


@router.delete("/{job_id}", status_code=204, operation_id="delete_job")
def delete(job_id: JobId, context: ContextDep) -> None:
    """Remove a job with its model, log and metrics, and its capture if no other job uses it."""
    context.jobs.delete(job_id)
