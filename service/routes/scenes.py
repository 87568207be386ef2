"""Routes of the player: the scene as a file, what its cameras are, and a held-out photograph beside the model."""

from __future__ import annotations

from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Header, Query, Response
from fastapi.responses import FileResponse

from graings.player.capture_cameras import capture_cameras
from graings.player.scene import CaptureCameras
from graings.player.scene_file import MEDIA_TYPE
from service.comparison import compare
from service.context import Context, ContextDep, JobId
from service.etags import matches
from service.problems import RESPONSES, NotYet
from service.rendering import LoadedModel
from service.scenes import scene_tag

router = APIRouter(prefix="/jobs/{job_id}", tags=["player"], responses=RESPONSES)

_YEAR_S = 365 * 24 * 3600
_SCENE: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The scene file, see docs/player.md",
        "content": {MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}},
        "headers": {
            "ETag": {"schema": {"type": "string"}},
            "X-Graings-Iteration": {"schema": {"type": "integer"}, "description": "Iteration of the checkpoint."},
        },
    },
    304: {"description": "The scene has not changed"},
}
_COMPARISON: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The pictures",
        "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}},
        "headers": {
            "X-Graings-PSNR": {"schema": {"type": "number"}, "description": "Of the model, in dB."},
            "X-Graings-Iteration": {"schema": {"type": "integer"}, "description": "Iteration of the checkpoint."},
        },
    }
}


@router.get("/scene", operation_id="get_scene", response_class=Response, responses=_SCENE)
async def scene(
    job_id: JobId,
    context: ContextDep,
    checkpoint: Annotated[
        int | None,
        Query(ge=0, description="Iteration for which the address is asked: its answer may be kept for ever."),
    ] = None,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """The newest checkpoint as a scene file for the player. The first request for a checkpoint takes seconds."""
    loaded = await to_thread.run_sync(_loaded, context, job_id)
    iteration = loaded.model.iteration
    headers = {
        "ETag": f'"{scene_tag(loaded)}"',
        "Cache-Control": f"private, max-age={_YEAR_S}, immutable" if checkpoint == iteration else "private, no-cache",
        "X-Graings-Iteration": str(iteration),
    }
    if matches(if_none_match, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    path = await to_thread.run_sync(context.scenes.path, context.store.folder(job_id).path, loaded)
    return FileResponse(path, media_type=MEDIA_TYPE, headers=headers)


@router.get("/views", operation_id="get_views")
def views(job_id: JobId, context: ContextDep) -> CaptureCameras:
    """Units, background and cameras of the capture, with which a player shows pictures before it has the scene."""
    return capture_cameras(_loaded(context, job_id).model)


@router.get("/comparison", operation_id="get_comparison", response_class=Response, responses=_COMPARISON)
async def comparison(
    job_id: JobId,
    context: ContextDep,
    camera: Annotated[
        str, Query(max_length=40, description="A view of the capture: val:0, test:3, train:12.")
    ] = "val:0",
) -> Response:
    """A photograph, the newest model from its camera, and their difference (5 times), side by side."""
    loaded = await to_thread.run_sync(_loaded, context, job_id)
    capture = await to_thread.run_sync(context.store.trained_on, job_id)
    found = await compare(capture, loaded, camera)
    headers = {
        "Cache-Control": "private, no-cache",
        "X-Graings-PSNR": f"{found.psnr:.2f}",
        "X-Graings-Iteration": str(loaded.model.iteration),
    }
    return Response(found.image, media_type="image/png", headers=headers)


def _loaded(context: Context, job_id: str) -> LoadedModel:
    loaded = context.models.load(context.store.folder(job_id).run)
    if loaded is None:
        raise NotYet(f"Job {job_id} has no checkpoint yet. Try again when the job has a render link.")
    return loaded
