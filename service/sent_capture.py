"""SentCapture: the capture that a request is about, in its body or sent before."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from anyio import to_thread
from fastapi import Query
from starlette.requests import Request

from jobs.job import CaptureNotFound
from service.access import Caller
from service.context import Context
from service.problems import BadRequest, UploadNotFound
from service.resumable import ResumableUpload
from service.uploads import CAPTURE_BODY, receive_capture, scene_capture

_UPLOAD_ID = 32  # letters; the digest of a capture has 64

CaptureParam = Annotated[
    str | None,
    Query(
        pattern=r"^([0-9a-f]{64}|[0-9a-f]{32})$",
        description="Instead of a body: `capture` of one of your jobs, or the `id` of a complete upload.",
    ),
]
# How routes describe their body that also accept a capture sent before.
OPTIONAL_BODY = {"requestBody": {**CAPTURE_BODY["requestBody"], "required": False}}


@dataclass(frozen=True, slots=True)
class SentCapture:
    """A capture as a folder, the SHA-256 of its archive, and the options of a form with it."""

    folder: Path
    digest: str
    config: dict[str, Any]
    stored: bool  # the folder is that of earlier jobs; else it is removed after the request, unless it was moved
    upload: ResumableUpload | None = None


@asynccontextmanager
async def sent_capture(
    request: Request, context: Context, caller: Caller, capture: str | None, scene: str | None = None
) -> AsyncIterator[SentCapture]:
    """The capture in the body of a request, or `capture` sent before, or the synthetic `scene`.

    Raises `BadRequest`, `ArchiveError`, `CaptureNotFound`, `UploadNotFound`, and `UploadConflict` while bytes of an
    upload are missing.
    """
    if capture is not None and scene is not None:
        raise BadRequest("capture, scene: choose one of them.")
    upload, digest = None, capture
    if capture is not None and len(capture) == _UPLOAD_ID:
        upload = await to_thread.run_sync(owned_upload, context, caller, capture)
        digest = upload.capture
    elif capture is not None:
        await to_thread.run_sync(_check_used, context, caller, capture)
    if digest is not None:
        folder = context.store.capture(digest)
        if not folder.is_dir():
            raise CaptureNotFound(digest)
        yield SentCapture(folder, digest, {}, stored=True, upload=upload)
        return
    archive = None if upload is None else upload.whole()
    received = receive_capture(request, context.store.uploads, context.limits, archive)
    async with received if scene is None else scene_capture(scene, context.store.uploads) as new:
        yield SentCapture(new.folder, new.digest, new.config, stored=False, upload=upload)


def owned_upload(context: Context, caller: Caller, upload_id: str) -> ResumableUpload:
    """The upload, if it is one of the caller's. Raises `UploadNotFound`."""
    upload = context.resumable.find(upload_id)
    if not caller.owns(upload.owner):
        raise UploadNotFound(upload_id)
    return upload


def _check_used(context: Context, caller: Caller, digest: str) -> None:
    """Raise `CaptureNotFound` unless a job that the caller may see uses the capture `digest`."""
    specs = ((job_id, context.jobs.spec(job_id)) for job_id in context.store.ids())
    if not any(spec.capture == digest and caller.sees(job_id, spec) for job_id, spec in specs):
        raise CaptureNotFound(digest)
