"""Routes of resumable uploads: begin one, send its parts, look how far it is.

`POST /jobs`, `POST /plans` and `POST /captures` take its id as `capture`.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Final

from anyio import to_thread
from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from pydantic import BaseModel, Field

from graings.config import make_config
from service.access import CallerDep
from service.context import MB, ContextDep
from service.problems import RESPONSES, BadRequest, UploadConflict
from service.resumable import ResumableUpload
from service.sent_capture import owned_upload
from service.uploads import parse_config

router = APIRouter(prefix="/uploads", tags=["uploads"], responses=RESPONSES)

_RANGE: Final = r"^bytes (\d{1,15})-(\d{1,15})/(\d{1,15})$"
_PART: Final[dict[str, Any]] = {
    "requestBody": {
        "required": True,
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}


class UploadResource(BaseModel):
    """A resumable upload."""

    id: str = Field(description="For `capture` of `POST /jobs`, `/plans` and `/captures`, once all bytes are there.")
    bytes: int = Field(description="Size of the whole archive.")
    received: int = Field(description="Bytes received; the next part begins with the byte of this number.")
    expires_at: float = Field(description="Unix seconds. Every part that arrives puts it off by a day.")

    @staticmethod
    def of(upload: ResumableUpload) -> UploadResource:
        return UploadResource(
            id=upload.path.name, bytes=upload.size, received=upload.received, expires_at=upload.expires_at
        )


async def owned(
    context: ContextDep,
    caller: CallerDep,
    upload_id: Annotated[str, Path(pattern="^[0-9a-f]{32}$", description="Id of an upload.")],
) -> ResumableUpload:
    """The upload, if it is one of the caller's. Raises `UploadNotFound`."""
    return await to_thread.run_sync(owned_upload, context, caller, upload_id)


OwnedDep = Annotated[ResumableUpload, Depends(owned)]


@router.post("", status_code=201, operation_id="begin_upload")
def begin(
    response: Response,
    context: ContextDep,
    caller: CallerDep,
    size: Annotated[int, Query(alias="bytes", ge=1, description="Size of the archive.")],
    preset: Annotated[str, Query(description="That of the job to come: a wrong one is refused.")] = "standard",
    config: Annotated[str | None, Query(description="Options of the job to come: wrong ones are refused.")] = None,
) -> UploadResource:
    """Begin an upload that can be continued after an interruption. It belongs to the key of the request.

    `preset` and `config` are only checked, so that a typing error is reported before gigabytes are uploaded.
    """
    make_config(preset, {} if config is None else parse_config(config, "config"))
    if size > context.settings.max_upload_mb * MB:
        raise BadRequest(f"bytes: an archive may have at most {context.settings.max_upload_mb * MB} bytes.")
    upload = context.resumable.begin(size, caller.owner)
    response.headers["Location"] = f"/uploads/{upload.path.name}"
    return UploadResource.of(upload)


@router.get("/{upload_id}", operation_id="get_upload")
def get(upload: OwnedDep) -> UploadResource:
    """How many bytes have arrived: after an interruption, send the others."""
    return UploadResource.of(upload)


@router.put("/{upload_id}", operation_id="continue_upload", openapi_extra=_PART)
async def put(
    request: Request,
    upload: OwnedDep,
    content_range: Annotated[
        str, Header(pattern=_RANGE, description="`bytes FIRST-LAST/ALL`, where FIRST is the number of bytes received.")
    ],
) -> UploadResource:
    """Append the bytes in the body. Those that arrive before an interruption count."""
    place, last, size = map(int, re.findall(r"\d+", content_range))
    if size != upload.size or not place <= last < size:
        raise UploadConflict(
            f"Content-Range: must be bytes FIRST-LAST/{upload.size} with FIRST <= LAST < {upload.size}."
        )
    async for chunk in request.stream():
        if place + len(chunk) > last + 1:
            raise UploadConflict("Content-Range: the body has more bytes than the range.")
        place = await to_thread.run_sync(upload.append, place, chunk)
    return UploadResource.of(upload)


@router.delete("/{upload_id}", status_code=204, operation_id="delete_upload")
def delete(upload: OwnedDep, context: ContextDep) -> None:
    """Give an upload up. A job that was made of it stays."""
    context.resumable.delete(upload.path.name)
