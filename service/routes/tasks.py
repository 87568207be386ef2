"""Routes of tasks: evaluations and videos of a trained job, made by a worker. `jobs.task_list` implements them."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi import Path as InPath
from fastapi.responses import FileResponse
from pydantic import BaseModel, Field

from graings.errors import CheckpointError
from graings.export.camera_path import frames_of
from graings.export.shown import Shown
from graings.export.video import check_video, video_size
from jobs.job import JobConflict, JobState
from jobs.task import MAX_FRAMES, EvaluationSpec, HeldOut, Task, TaskProgress, TaskSpec, VideoSpec
from service.context import ContextDep, JobId
from service.problems import RESPONSES, BadRequest, NotYet
from service.rendering import LoadedModel

router = APIRouter(prefix="/jobs/{job_id}", tags=["tasks"], responses=RESPONSES)

MEDIA_TYPES = {"mp4": "video/mp4", "webm": "video/webm", "webp": "image/webp", "gif": "image/gif"}
RETRY_AFTER_S = "1"

TaskId = Annotated[str, InPath(description="Id of a task.", examples=["019a2b3c4d5e8f01"], max_length=64)]


class TaskResource(BaseModel):
    """An evaluation or a video that was asked for."""

    id: str = Field(description="Identifies the task within its job.")
    spec: TaskSpec = Field(description="What was asked for.")
    state: JobState = Field(description="Where the task is in its life.")
    created_at: datetime = Field(description="When it was asked for.")
    finished_at: datetime | None = Field(description="When it ended; null before.")
    progress: TaskProgress | None = Field(description="Of a video that is being made; null before.")
    error: str | None = Field(description="Why it failed, with a remedy; null otherwise.")
    links: dict[str, str] = Field(description="Addresses: the task itself and, once it has succeeded, its result.")


class TaskPage(BaseModel):
    """The tasks of a job, newest first."""

    tasks: list[TaskResource] = Field(description="The tasks.")


@router.post("/evaluate", status_code=202, operation_id="evaluate_job")
def evaluate(
    job_id: JobId,
    context: ContextDep,
    response: Response,
    split: Annotated[
        HeldOut, Query(description="Held-out views: val, test or between (times between those of training).")
    ] = "test",
) -> TaskResource:
    """Measure the model of a job that has ended on held-out views; its metrics then have this split too."""
    job = context.jobs.get(job_id)
    if not job.state.final:
        raise JobConflict(f"Job {job_id} is {job.state}: its metrics are still written. Evaluate it when it has ended.")
    _check_split(_model(context, job_id), split)
    return _accepted(context.tasks.submit(job_id, EvaluationSpec(split=split)), response)


@router.post("/videos", status_code=202, operation_id="make_video")
def make_video(job_id: JobId, spec: VideoSpec, context: ContextDep, response: Response) -> TaskResource:
    """Have a video of the newest model made."""
    loaded = _model(context, job_id)
    if spec.frames > MAX_FRAMES:
        raise BadRequest(f"seconds x fps is {spec.frames} frames; at most {MAX_FRAMES} are made.")
    model = loaded.model
    shown = Shown(loaded.scene, model.units, model.views, model.background, model.digest)
    try:  # now, while the client waits: nothing but the rendering is left to the worker
        check_video(Path(f"video.{spec.format}"), spec.fps)
        frames = frames_of(shown, spec.request, spec.path, spec.moves, spec.frames)
        video_size(Path(f"video.{spec.format}"), frames[0][0])
    except (ValueError, CheckpointError) as error:
        raise BadRequest(f"{error}".rstrip(".") + ".") from error
    if len(frames) > MAX_FRAMES:  # a path of nerfstudio's brings its own
        raise BadRequest(f"path: has {len(frames)} frames; at most {MAX_FRAMES} are made.")
    return _accepted(context.tasks.submit(job_id, spec), response)


@router.get("/tasks", operation_id="list_tasks")
def tasks(job_id: JobId, context: ContextDep) -> TaskPage:
    """The evaluations and videos of a job."""
    return TaskPage(tasks=[_resource(task) for task in context.tasks.all(job_id)])


@router.get("/tasks/{task_id}", operation_id="get_task")
def task(job_id: JobId, task_id: TaskId, context: ContextDep, response: Response) -> TaskResource:
    """A task with its state and progress."""
    found = context.tasks.get(job_id, task_id)
    if not found.state.final:
        response.headers["Retry-After"] = RETRY_AFTER_S
    return _resource(found)


@router.delete("/tasks/{task_id}", status_code=204, operation_id="delete_task")
def delete(job_id: JobId, task_id: TaskId, context: ContextDep) -> None:
    """Stop a task if it has not ended, and remove it with its video."""
    context.tasks.delete(job_id, task_id)


@router.get("/tasks/{task_id}/video", operation_id="get_video", response_class=FileResponse)
def video(job_id: JobId, task_id: TaskId, context: ContextDep) -> Response:
    """The video of a task that has succeeded."""
    found = context.tasks.get(job_id, task_id)
    if not isinstance(found.spec, VideoSpec) or found.state is not JobState.SUCCEEDED:
        raise NotYet(f"This task has no video: its kind is {found.spec.kind}, its state {found.state}.")
    path = context.tasks.folder(job_id, task_id).video(found.spec)
    return FileResponse(path, media_type=MEDIA_TYPES[found.spec.format], filename=f"{job_id}{path.suffix}")


def _model(context: ContextDep, job_id: str) -> LoadedModel:
    loaded = context.models.load(context.store.folder(job_id).run)
    if loaded is None:
        raise NotYet(f"Job {job_id} has no checkpoint yet. Try again when the job has a render link.")
    return loaded


def _check_split(loaded: LoadedModel, split: HeldOut) -> None:
    if not loaded.model.views.get(split):
        there = ", ".join(name for name, views in loaded.model.views.items() if views and name != "train") or "none"
        raise BadRequest(f"split: the capture has no views of {split}; it holds out {there}.")


def _accepted(task: Task, response: Response) -> TaskResource:
    resource = _resource(task)
    response.headers["Location"] = resource.links["self"]
    response.headers["Retry-After"] = RETRY_AFTER_S
    return resource


def _resource(task: Task) -> TaskResource:
    base = f"/jobs/{task.job_id}"
    links = {"self": f"{base}/tasks/{task.id}", "job": base}
    if task.state is JobState.SUCCEEDED:
        made = isinstance(task.spec, VideoSpec)
        links |= {"video": f"{base}/tasks/{task.id}/video"} if made else {"metrics": f"{base}/metrics"}
    return TaskResource(
        id=task.id,
        spec=task.spec,
        state=task.state,
        created_at=datetime.fromtimestamp(task.created_at, UTC),
        finished_at=None if task.finished_at is None else datetime.fromtimestamp(task.finished_at, UTC),
        progress=task.progress,
        error=task.error,
        links=links,
    )
