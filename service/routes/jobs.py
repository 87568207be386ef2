"""Routes of jobs: submit, list, get, cancel, resume, retry, delete. `jobs.queue` implements them."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import urlencode

from anyio import to_thread
from fastapi import APIRouter, Header, Query, Request, Response
from pydantic import HttpUrl

from graings.config import PRESETS, make_config
from jobs.job import ID_PATTERN, CaptureNotFound, Job, JobSpec, JobState
from service.access import Caller, CallerDep
from service.context import Context, ContextDep, JobId
from service.inspection import inspect_capture
from service.problems import RESPONSES, BadRequest
from service.routes.uploads import owned
from service.schemas import JobPage, JobResource, job_resource, job_summary
from service.uploads import CAPTURE_BODY, parse_config, receive_capture, scene_capture

router = APIRouter(prefix="/jobs", tags=["jobs"], responses=RESPONSES)

RETRY_AFTER_S = "2"
_UPLOAD_ID = 32  # letters; a capture has 64

# Without a body where `capture` names one that was sent before, or `scene` a synthetic one.
OPTIONAL_BODY = {"requestBody": {**CAPTURE_BODY["requestBody"], "required": False}}


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
    capture: Annotated[
        str | None,
        Query(
            pattern=r"^([0-9a-f]{64}|[0-9a-f]{32})$",
            description="Instead of a body: `capture` of one of your jobs, or the `id` of a complete upload.",
        ),
    ] = None,
    scene: Annotated[
        str | None,
        Query(max_length=40, description="A synthetic scene of /options, instead of a body: the job draws it first."),
    ] = None,
) -> JobResource:
    """Queue a training job on the capture in the body: an archive, or a multipart form with one as `capture`."""
    overrides = {} if config is None else parse_config(config, "config")
    # Checked before the body is read, so that a typing error is reported before gigabytes are uploaded.
    again = make_config(preset, overrides)
    title = name or scene or "untitled"
    if capture is not None and scene is not None:
        raise BadRequest("capture, scene: choose one of them.")
    webhook_address = None if webhook is None else str(webhook)
    resumed = None
    if capture is not None and len(capture) == _UPLOAD_ID:
        resumed = await to_thread.run_sync(owned, context, caller, capture)
        capture = resumed.capture
    elif capture is not None:
        await to_thread.run_sync(_check_used, context, caller, capture)
    if capture is not None:
        if not context.store.capture(capture).is_dir():
            raise CaptureNotFound(capture)
        await inspect_capture(context.store.capture(capture), again.capture)
        spec = JobSpec(title, capture, again.model_dump(mode="json"), priority, caller.owner, webhook_address)
        return _accepted(await to_thread.run_sync(context.jobs.submit, spec, None, idempotency_key), response)
    uploads, archive = context.store.uploads, None if resumed is None else resumed.whole()
    received = receive_capture(request, uploads, context.limits, archive)
    async with received if scene is None else scene_capture(scene, uploads) as upload:
        chosen = make_config(preset, {**overrides, **upload.config})
        await inspect_capture(upload.folder, chosen.capture)
        spec = JobSpec(title, upload.digest, chosen.model_dump(mode="json"), priority, caller.owner, webhook_address)
        job = await to_thread.run_sync(context.jobs.submit, spec, upload.folder, idempotency_key)
        if resumed is not None:
            await to_thread.run_sync(resumed.write, upload.digest)
    return _accepted(job, response)


def _accepted(job: Job, response: Response) -> JobResource:
    response.headers["Location"] = f"/jobs/{job.id}"
    response.headers["Retry-After"] = RETRY_AFTER_S
    return job_resource(job).model_copy(update={"webhook_secret": job.spec.webhook_secret})


def _check_used(context: Context, caller: Caller, digest: str) -> None:
    """Raise `CaptureNotFound` unless a job that the caller may see uses the capture `digest`."""
    specs = ((job_id, context.jobs.spec(job_id)) for job_id in context.store.ids())
    if not any(spec.capture == digest and caller.sees(job_id, spec) for job_id, spec in specs):
        raise CaptureNotFound(digest)


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
def get(job_id: JobId, response: Response, context: ContextDep) -> JobResource:
    """A job with its state and progress."""
    job = context.jobs.get(job_id)
    if not job.state.final:
        response.headers["Retry-After"] = RETRY_AFTER_S
    return job_resource(job)


@router.post("/{job_id}/cancel", status_code=202, operation_id="cancel_job")
def cancel(job_id: JobId, context: ContextDep) -> JobResource:
    """Stop a job at a checkpoint from which it can be resumed. Cancelling it again changes nothing."""
    return job_resource(context.jobs.cancel(job_id))


@router.post("/{job_id}/resume", status_code=202, operation_id="resume_job")
def resume(job_id: JobId, context: ContextDep) -> JobResource:
    """Queue a cancelled job again; it continues where it stopped. Resuming it again changes nothing."""
    return job_resource(context.jobs.resume(job_id))


@router.post("/{job_id}/retry", status_code=202, operation_id="retry_job")
def retry(job_id: JobId, context: ContextDep) -> JobResource:
    """Queue a failed or diverged job again; it continues from its last checkpoint, if any."""
    return job_resource(context.jobs.retry(job_id))


@router.post("/{job_id}/extend", status_code=202, operation_id="extend_job")
def extend(
    job_id: JobId,
    context: ContextDep,
    iterations: Annotated[int, Query(ge=1, le=1_000_000, description="How many more.")],
) -> JobResource:
    """Train a job that has succeeded for more iterations, from its last checkpoint; its model stays until then."""
    return job_resource(context.jobs.extend(job_id, iterations))


@router.delete("/{job_id}", status_code=204, operation_id="delete_job")
def delete(job_id: JobId, context: ContextDep) -> None:
    """Remove a job with its model, log and metrics, and its capture if no other job uses it."""
    context.jobs.delete(job_id)
