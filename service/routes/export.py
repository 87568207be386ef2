"""The route of exports: a trained scene at one time in the formats of other tools."""

from __future__ import annotations

import threading
from typing import Annotated, Final

from fastapi import APIRouter, Query, Response
from pydantic import BaseModel, ConfigDict, Field

from graings.export.export import FORMATS, FRAMES, SEQUENCE, ExportRequest, check_used, export_splats
from graings.export.selection import Selection
from service.context import ContextDep, JobId
from service.problems import RESPONSES, BadRequest, Busy, NotYet

router = APIRouter(prefix="/jobs/{job_id}", tags=["results"], responses=RESPONSES)

MAX_FRAMES: Final = 120  # a client waits for the answer; longer sequences are for the command line

_ONE = threading.Lock()  # an export takes seconds of every core


class ExportQuery(BaseModel):
    """Parameters of an export."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    format: str = Field(
        json_schema_extra={"enum": list(FORMATS)},
        description="ply, compressed.ply, spz, sog, splat, glb, zip: a sequence of PLY files, or 4dgs.",
    )
    t: float | None = Field(None, ge=0, le=1, description="Time of a format that holds one; default: 0.")
    frames: int | None = Field(
        None, ge=1, le=MAX_FRAMES, description=f"Number of times in a zip or 4dgs; default: {FRAMES}."
    )
    degree: int | None = Field(None, ge=0, le=3, description="Of the spherical harmonics; default: what is needed.")
    box: str | None = Field(None, max_length=240, description="Keep what is in x,y,z,x,y,z, the capture's units.")
    sphere: str | None = Field(None, max_length=160, description="Keep what is in x,y,z,radius.")
    seen: bool = Field(False, description="Drop splats that no training view shows.")


@router.get("/export", operation_id="get_export", response_class=Response)
def export(job_id: JobId, here: ContextDep, query: Annotated[ExportQuery, Query()]) -> Response:
    """The newest model of a job as splats. One export is made at a time."""
    try:
        selection = Selection(_numbers(query.box), _numbers(query.sphere), query.seen)
        request = ExportRequest(query.format, query.t or 0.0, query.frames or FRAMES, query.degree, selection)
        check_used(query.format, time=query.t, frames=query.frames, degree=query.degree)
    except ValueError as error:
        raise BadRequest(f"{error}.") from error
    loaded = here.models.load(here.store.folder(job_id).run)
    if loaded is None:
        raise NotYet(f"Job {job_id} has no checkpoint yet. Try again when the job has a render link.")
    if not _ONE.acquire(blocking=False):
        raise Busy("Another export is being made. Try again in a few seconds.")
    try:
        exported = export_splats(loaded.model, request)
    except ValueError as error:
        raise BadRequest(f"{error}.") from error
    finally:
        _ONE.release()
    headers = {
        "Content-Disposition": f'attachment; filename="{job_id}.{query.format}"',
        "X-Graings-Splats": str(exported.splats),
        "X-Graings-Dropped": str(exported.dropped),
        "X-Graings-Degree": str(exported.degree),
        "Cache-Control": "private, no-cache",
    }
    media = "application/zip" if query.format == SEQUENCE else "application/octet-stream"
    return Response(exported.data, media_type=media, headers=headers)


def _numbers(text: str | None) -> tuple[float, ...] | None:
    return None if text is None else tuple(float(part) for part in text.split(","))
