"""The route of pictures: a model from any viewpoint at any time."""

from __future__ import annotations

import hashlib
import json
import math
from typing import Annotated, Any

import numpy as np
from anyio import to_thread
from fastapi import APIRouter, Header, Query, Response
from pydantic import BaseModel, ConfigDict, Field

import graings
from graings.camera.camera import Camera, View
from graings.camera.viewpoint import background_rgb, named_view, orbit_view, pose_camera, sized
from graings.errors import CheckpointError
from graings.image_encoding import FORMATS, MEDIA_TYPES, ImageFormat
from graings.storage.model import Model
from jobs.job import JobNotFound
from service.context import Context, ContextDep
from service.negotiation import preferred
from service.problems import RESPONSES, BadRequest, NotAcceptable, NotYet
from service.scenes import Picture

router = APIRouter(tags=["render"])

MAX_SIDE = 4096
_ORBIT = ("azimuth", "elevation", "radius", "target", "fov")
_POSE = ("pose", "fx", "fy", "cx", "cy")
_IMAGES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The picture",
        "content": {media: {"schema": {"type": "string", "format": "binary"}} for media in MEDIA_TYPES.values()},
        "headers": {
            "ETag": {"schema": {"type": "string"}},
            "X-Graings-Job": {"schema": {"type": "string"}, "description": "Whose model this is."},
            "X-Graings-Iteration": {"schema": {"type": "integer"}, "description": "Of the checkpoint that was drawn."},
            "X-Graings-Finished": {"schema": {"type": "boolean"}, "description": "false while training goes on."},
            "X-Graings-Orbit": {
                "schema": {"type": "string"},
                "description": "azimuth elevation radius, when orbiting.",
            },
            "X-Time-Clamped": {"schema": {"type": "number"}, "description": "The time drawn, if t was outside [0, 1]."},
        },
    },
    304: {"description": "The client has this picture"},
}


class RenderQuery(BaseModel):
    """What to draw. The viewpoint is a view of the capture, an orbit, or a pose; by default an orbit."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    job: str | None = Field(None, max_length=64, description="Whose model; by default the newest job that has one.")
    t: float | None = Field(
        None, description="Time in [0, 1], clamped. Default: that of the view named by `camera`, else 0."
    )
    camera: str | None = Field(None, max_length=40, description="A view of the capture: train:0, val:3, test:12.")
    azimuth: float | None = Field(None, description="Orbit: degrees about the vertical (default 0).")
    elevation: float | None = Field(
        None, ge=-90, le=90, description="Orbit: degrees from the horizon (default: median)."
    )
    radius: float | None = Field(
        None, gt=0, description="Orbit: distance from target, capture units (default: median)."
    )
    target: str | None = Field(None, max_length=120, description="Orbit: x,y,z in capture units (default: the centre).")
    fov: float | None = Field(
        None, gt=0, lt=180, description="Orbit: horizontal angle in degrees (default: the capture's)."
    )
    pose: str | None = Field(
        None,
        max_length=4_000,
        description="World-to-camera, 4x4 row-major JSON; OpenCV axes (x right, y down, z forward), capture units.",
    )
    fx: float | None = Field(None, gt=0, description="Pose: focal length in pixels.")
    fy: float | None = Field(None, gt=0, description="Pose: focal length in pixels (default fx).")
    cx: float | None = Field(None, description="Pose: principal point in pixels (default: the middle).")
    cy: float | None = Field(None, description="Pose: principal point in pixels (default: the middle).")
    width: int | None = Field(None, ge=1, le=MAX_SIDE, description="Pixels; with one length the shape is kept.")
    height: int | None = Field(None, ge=1, le=MAX_SIDE, description="Pixels.")
    background: str | None = Field(None, max_length=60, description="white, black, #rrggbb or r,g,b in [0, 1].")
    format: ImageFormat | None = Field(None, description="Instead of the Accept header.")


@router.get("/render", operation_id="render", response_class=Response, responses={**_IMAGES, **RESPONSES})
async def render(
    query: Annotated[RenderQuery, Query()],
    here: ContextDep,
    accept: Annotated[str | None, Header()] = None,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """A picture of the newest model, or of a job's newest checkpoint while it trains, at time `t` from a viewpoint."""
    format = query.format or _format(accept)
    job_id, model = await to_thread.run_sync(_model, here, query.job)
    try:
        camera, own_time = _viewpoint(model, query)
        background = model.background if query.background is None else background_rgb(query.background)
    except ValueError as error:
        raise BadRequest(f"{error}.") from error
    if max(camera.width, camera.height) > MAX_SIDE:
        raise BadRequest(f"{camera.width}x{camera.height} is too large: at most {MAX_SIDE} pixels a side.")
    asked = own_time if query.t is None else query.t
    time = min(1.0, max(0.0, asked))
    picture = Picture(camera, time, background, format)
    headers = {
        "ETag": _etag(model, picture),
        "Vary": "Accept",
        # The newest checkpoint changes under the same address: ask again each time, which is cheap.
        "Cache-Control": "private, no-cache",
        "X-Graings-Job": job_id,
        "X-Graings-Iteration": str(model.iteration),
        "X-Graings-Finished": str(model.finished).lower(),
    }
    if time != asked:
        headers["X-Time-Clamped"] = f"{time:g}"
    if query.camera is None and query.pose is None:
        headers["X-Graings-Orbit"] = _orbit_header(model, query, camera)
    if _matches(if_none_match, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    image = await here.pool.draw(model, picture)
    return Response(image, media_type=MEDIA_TYPES[format], headers=headers)


def _format(accept: str | None) -> ImageFormat:
    media = preferred(accept, [MEDIA_TYPES[format] for format in FORMATS])
    for format in FORMATS:
        if MEDIA_TYPES[format] == media:
            return format
    raise NotAcceptable(f"On offer: {', '.join(MEDIA_TYPES.values())}.")


def _model(here: Context, job_id: str | None) -> tuple[str, Model]:
    """The model of a job, or of the newest job that has one. Blocks."""
    if job_id is not None:
        model = here.scenes.load(here.store.folder(job_id).run)
        if model is None:
            raise NotYet(f"Job {job_id} has no checkpoint yet. Try again when its resource has a render link.")
        return job_id, model
    damaged: CheckpointError | None = None
    for candidate in here.store.ids():
        try:
            model = here.scenes.load(here.store.folder(candidate).run)
        except JobNotFound:
            continue  # deleted meanwhile
        except CheckpointError as error:
            damaged = damaged or error
            continue
        if model is not None:
            return candidate, model
    if damaged is not None:
        raise damaged
    raise NotYet("There is no model yet. Submit a capture to /jobs.")


def _viewpoint(model: Model, query: RenderQuery) -> tuple[Camera, float]:
    """The camera that was asked for, normalised, and the time that goes with it. Raises `ValueError`."""
    asked = {
        kind: [name for name in names if getattr(query, name) is not None]
        for kind, names in {"view": ("camera",), "orbit": _ORBIT, "pose": _POSE}.items()
    }
    kinds = [kind for kind, names in asked.items() if names]
    if len(kinds) > 1:
        named = ", ".join(name for names in asked.values() for name in names)
        raise ValueError(f"one viewpoint at a time: a view, an orbit or a pose, not {named} together")
    if query.camera is not None:
        view = named_view(model.views, query.camera)
        return sized(view.camera, query.width, query.height), view.time
    if "pose" in kinds:
        return _posed(model, query), 0.0
    camera = orbit_view(
        _reference_views(model),
        model.units,
        query.azimuth or 0.0,
        query.elevation,
        query.radius,
        None if query.target is None else _numbers(query.target, "target", 3),
        query.fov,
        query.width,
        query.height,
    )
    return camera, 0.0


def _orbit_header(model: Model, query: RenderQuery, camera: Camera) -> str:
    """Azimuth, elevation and radius of the orbit drawn, so that a client who gave none can go on from there."""
    target = model.units.center if query.target is None else _numbers(query.target, "target", 3)
    arm = camera.center - model.units.points(target)
    length = float(np.linalg.norm(arm))
    elevation = math.degrees(math.asin(max(-1.0, min(1.0, float(arm @ np.asarray(model.units.up)) / length))))
    return f"{query.azimuth or 0.0:g} {elevation:.6g} {length / model.units.scale:.6g}"


def _reference_views(model: Model) -> tuple[View, ...]:
    return model.views.get("train", ())


def _posed(model: Model, query: RenderQuery) -> Camera:
    if query.pose is None or query.fx is None or query.width is None or query.height is None:
        raise ValueError("a pose needs pose, fx, width and height")
    try:
        matrix = np.array(json.loads(query.pose), dtype=np.float64)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"pose must be a JSON list of four rows of four numbers ({error})") from error
    width, height = query.width, query.height
    cx = width / 2 if query.cx is None else query.cx
    cy = height / 2 if query.cy is None else query.cy
    return pose_camera(model.units, matrix, query.fx, query.fy or query.fx, cx, cy, width, height)


def _numbers(text: str, name: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ValueError(f"{name} must be {count} finite numbers with commas between them, got {text!r}")
    return values


def _etag(model: Model, picture: Picture) -> str:
    """Changes whenever a byte of the answer could."""
    camera = picture.camera
    parts = (
        graings.__version__,
        model.digest,
        camera.world_to_camera.tolist(),
        (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height),
        (picture.time, picture.background, picture.format),
    )
    return f'"{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}"'


def _matches(if_none_match: str | None, etag: str) -> bool:
    known = [tag.strip().removeprefix("W/") for tag in (if_none_match or "").split(",")]
    return etag in known or "*" in known
