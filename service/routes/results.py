"""Routes of the results of a job: plan, metrics, curve, report, model and log; its progress as a stream of events."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Annotated, Any

from anyio import sleep, to_thread
from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.responses import FileResponse, PlainTextResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from graings.plan.plan import Plan
from graings.report.metrics_document import Metrics
from graings.report.work_precision_document import REPORT_FILE, WorkPrecision
from jobs.job import Job, JobNotFound, JobState
from jobs.progress import last_start, read_progress
from service.access import CallerDep
from service.context import ContextDep, JobId
from service.problems import RESPONSES, NotYet
from service.schemas import job_resource

router = APIRouter(prefix="/jobs/{job_id}", tags=["results"], responses=RESPONSES)

POLL_S = 0.5
RECONNECT_MS = 2_000
_MAX_LOG = 4 << 20

# The framework describes the frame of a server-sent event; this adds what its data are.
EVENT_STREAM: dict[str, Any] = {
    "description": "`progress` events carry a ProgressReport, `state` and `end` events a JobResource.",
    "content": {
        "text/event-stream": {
            "itemSchema": {
                "properties": {
                    "data": {
                        "contentMediaType": "application/json",
                        "contentSchema": {
                            "anyOf": [
                                {"$ref": "#/components/schemas/ProgressReport"},
                                {"$ref": "#/components/schemas/JobResource"},
                            ]
                        },
                    }
                }
            }
        }
    },
}


@router.get("/metrics", operation_id="get_metrics", response_model=Metrics)
def metrics(job_id: JobId, here: ContextDep) -> Response:
    """The metrics document, schema `graings.metrics/1`; it is rewritten after every evaluation."""
    return _current(here.store.folder(job_id).metrics, "metrics")


@router.get("/plan", operation_id="get_plan", response_model=Plan)
def plan(job_id: JobId, here: ContextDep) -> Response:
    """The plan of the training, schema `graings.plan/1`; training adds what it decides and what it measured."""
    when = "It comes when training begins; POST /plans makes one."
    return _current(here.store.folder(job_id).plan, "plan", when)


@router.get("/curve.svg", operation_id="get_curve", response_class=FileResponse)
def curve(job_id: JobId, here: ContextDep) -> Response:
    """Held-out error against training time, as a plot."""
    return _current(here.store.folder(job_id).curve, "curve")


@router.get("/report", operation_id="get_report", response_model=WorkPrecision)
def report(job_id: JobId, here: ContextDep) -> Response:
    """The work-precision report, schema `graings.work_precision/1`: error against time, iterations and Gaussians."""
    return _current(here.store.folder(job_id).report / REPORT_FILE, "report")


@router.get("/report.svg", operation_id="get_report_plot", response_class=FileResponse)
def report_plot(job_id: JobId, here: ContextDep) -> Response:
    """The work-precision report as a plot."""
    return _current(here.store.folder(job_id).report / "training.svg", "report")


@router.get("/model", operation_id="get_model", response_class=FileResponse)
def model(job_id: JobId, here: ContextDep) -> Response:
    """The trained model as one small file, for `graings render`."""
    path = _existing(here.store.folder(job_id).model, "model", "It comes when training ends.")
    return FileResponse(path, media_type="application/octet-stream", filename=f"{job_id}.graings")


@router.get("/log", operation_id="get_log", response_class=PlainTextResponse)
def log(job_id: JobId, here: ContextDep, tail: Annotated[int, Query(ge=1, le=100_000)] = 1_000) -> Response:
    """The last `tail` lines of the trainer's log."""
    path = here.store.folder(job_id).log
    if not path.exists():
        return PlainTextResponse("")
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _MAX_LOG))
        lines = file.read().splitlines(keepends=True)
    return PlainTextResponse(b"".join(lines[-tail:]).decode("utf-8", "replace"))


async def _known(job_id: JobId, here: ContextDep) -> Job:
    """The job, looked up before the stream begins: afterwards the status can no longer be 404."""
    return await to_thread.run_sync(here.jobs.get, job_id)


@router.get("/events", operation_id="get_events", response_class=EventSourceResponse, responses={200: EVENT_STREAM})
async def events(
    request: Request,
    here: ContextDep,
    caller: CallerDep,
    job: Annotated[Job, Depends(_known)],
    last_event_id: Annotated[
        int | None, Header(ge=0, description="Continue after this event; 0 starts at the first report.")
    ] = None,
) -> AsyncIterator[ServerSentEvent]:
    """`progress` (the trainer's reports), `state` (the job, whenever its state changes) and, last of all, `end`.

    Without Last-Event-ID the stream starts with the newest report.
    """
    path = here.store.folder(job.id).progress
    position = last_event_id if last_event_id is not None else await to_thread.run_sync(last_start, path)
    state: JobState | None = None
    while not (request.app.state.stopping() or await request.is_disconnected()):
        try:
            # The state first: all that was reported before the job ended is then read below.
            job = await to_thread.run_sync(here.jobs.get, job.id)
        except JobNotFound:
            return  # the job was deleted
        lines, position = await to_thread.run_sync(read_progress, path, position)
        for place, report in lines:
            yield ServerSentEvent(event="progress", id=str(place), data=report, retry=RECONNECT_MS)
        if job.state is not state:
            state = job.state
            yield ServerSentEvent(event="state", data=job_resource(job, caller))
        if state.final:
            yield ServerSentEvent(event="end", data=job_resource(job, caller))
            return
        await sleep(POLL_S)


def _existing(path: Path, what: str, when: str) -> Path:
    if not path.exists():
        raise NotYet(f"This job has no {what} yet. {when}")
    return path


def _current(path: Path, what: str, when: str = "It comes with the first evaluation.") -> Response:
    """A file that training writes again."""
    media_type = "image/svg+xml" if path.suffix == ".svg" else "application/json"
    headers = {"Cache-Control": "no-cache"}
    return Response(_existing(path, what, when).read_bytes(), media_type=media_type, headers=headers)
