"""Task: what a trained job is asked for that takes longer than a request: an evaluation or a video.

    <job>/tasks/<id>/    task.json, progress.json, and the video

A task waits in the queue beside the jobs, and survives the death of its worker: a video then goes on where it was, an
evaluation begins again.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from graings.camera.view_request import MAX_SIDE, ViewRequest
from graings.document import Document, read_document
from graings.export.camera_path import Moves
from graings.storage.files import write_document
from jobs.job import JobError, JobState, new_id

MAX_FRAMES: Final = 3_600
HeldOut = Literal["val", "test", "between"]
VideoFormat = Literal["mp4", "webm", "webp", "gif"]

_TASK, _PROGRESS = "task.json", "progress.json"
_REMEDY: Final = "Delete the task and ask for it again."


class TaskNotFound(JobError):
    """The job has no such task."""

    def __init__(self, job_id: str, number: str) -> None:
        super().__init__(f"Job {job_id} has no task {number!r}. /jobs/{job_id}/tasks lists them.")


class EvaluationSpec(Document):
    """Measure the model on held-out views; the result is added to the metrics of the job."""

    kind: Literal["evaluation"] = "evaluation"
    split: HeldOut = Field(
        "test", description="Held-out views: val, test or between (times between those of training)."
    )


class VideoSpec(Document):
    """Render a video of the newest model."""

    kind: Literal["video"] = "video"
    format: VideoFormat = Field("mp4", description="Container: H.264, VP9, or an animated picture.")
    moves: Moves = Field("both", description="time, at a fixed camera; camera, at the time t; or both.")
    path: Literal["orbit", "views"] | dict[str, Any] | None = Field(
        None,
        description="Of the camera: orbit, once around; views, a spline through training views; or an object with keys "
        "or nerfstudio's camera_path (docs/export.md). Default: orbit, or views if all training views are on one side.",
    )
    seconds: float = Field(4.0, gt=0, le=600, description="Length.")
    fps: float = Field(30.0, ge=0.1, le=240, description="Frames per second.")
    t: float | None = Field(None, ge=0, le=1, description="Time while only the camera moves (default: 0).")
    camera: str | None = Field(None, max_length=40, description="A view of the capture: train:0, val:3, test:12.")
    azimuth: float | None = Field(None, description="Orbit: degrees about the vertical at the start.")
    elevation: float | None = Field(None, ge=-90, le=90, description="Orbit: degrees above the horizon.")
    radius: float | None = Field(None, gt=0, description="Orbit: distance from target, capture units.")
    target: tuple[float, float, float] | None = Field(None, description="Orbit: x, y, z in capture units.")
    fov: float | None = Field(None, gt=0, lt=180, description="Orbit: horizontal angle in degrees.")
    width: int | None = Field(None, ge=1, le=MAX_SIDE, description="Pixels; one alone keeps the aspect ratio.")
    height: int | None = Field(None, ge=1, le=MAX_SIDE, description="Pixels.")
    background: str | None = Field(None, max_length=60, description="white, black, #rrggbb or r,g,b in [0, 1].")

    @property
    def frames(self) -> int:
        """Number of frames."""
        return max(1, round(self.seconds * self.fps))

    @property
    def request(self) -> ViewRequest:
        """The view at the start."""
        names = ("camera", "azimuth", "elevation", "radius", "target", "fov", "width", "height", "t", "background")
        return ViewRequest(**{name: getattr(self, name) for name in names})


TaskSpec = Annotated[EvaluationSpec | VideoSpec, Field(discriminator="kind")]


class TaskRecord(Document):
    """The file `task.json`."""

    created_at: float = Field(description="Unix seconds.")
    spec: TaskSpec


class TaskProgress(Document):
    """How much of a task is done."""

    done: int = Field(ge=0, description="Frames that are rendered.")
    total: int = Field(ge=0, description="Frames of the video.")


@dataclass(frozen=True, slots=True)
class TaskFolder:
    """The files of one task."""

    path: Path

    @classmethod
    def create(cls, tasks: Path, spec: TaskSpec) -> TaskFolder:
        """A new task in the folder of all tasks of a job."""
        made = time.time()
        folder = cls(tasks / new_id(made))
        folder.path.mkdir(parents=True)
        write_document(folder.path / _TASK, TaskRecord(created_at=made, spec=spec))
        return folder

    @property
    def record(self) -> TaskRecord:
        """Raises `CheckpointError` if it is damaged."""
        return read_document(self.path / _TASK, TaskRecord, _REMEDY)

    @property
    def progress(self) -> TaskProgress | None:
        """The newest progress; None before the first."""
        file = self.path / _PROGRESS
        return read_document(file, TaskProgress, _REMEDY) if file.exists() else None

    def write_progress(self, done: int, total: int) -> None:
        """Replace the progress."""
        write_document(self.path / _PROGRESS, TaskProgress(done=done, total=total))

    def video(self, spec: VideoSpec) -> Path:
        """The file of the video."""
        return self.path / f"video.{spec.format}"


@dataclass(frozen=True, slots=True)
class Task:
    """A task with its state, as clients see it. Times are Unix seconds."""

    id: str
    job_id: str
    spec: TaskSpec
    state: JobState
    created_at: float
    finished_at: float | None
    progress: TaskProgress | None
    error: str | None
