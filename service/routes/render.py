"""The route of images: a model rendered from any viewpoint at any time."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import AsyncIterator, Mapping
from contextlib import ExitStack
from time import perf_counter
from typing import Annotated, Any

import numpy as np
from anyio import to_thread
from fastapi import APIRouter, Depends, Header, Query, Response
from pydantic import BaseModel, ConfigDict, Field
from werkzeug.datastructures import MIMEAccept
from werkzeug.http import parse_accept_header

import graings
from graings.camera.camera import Camera
from graings.camera.orbit import azimuths, elevations
from graings.camera.units import Units
from graings.camera.view_request import MAX_SIDE, ViewRequest
from graings.errors import CheckpointError
from graings.export.picture import Content, check_content
from graings.image_encoding import FORMATS, MEDIA_TYPES, ImageFormat
from graings.storage.model import Model
from jobs.job import JobNotFound
from service.access import Caller, CallerDep
from service.context import Context, ContextDep
from service.etags import matches
from service.problems import RESPONSES, BadRequest, NotAcceptable, NotYet
from service.rendering import LoadedModel, RenderRequest

router = APIRouter(tags=["render"])

_INTRINSICS = ("fx", "fy", "cx", "cy")
_IMAGES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The image",
        "content": {media: {"schema": {"type": "string", "format": "binary"}} for media in MEDIA_TYPES.values()},
        "headers": {
            "ETag": {"schema": {"type": "string"}},
            "X-Graings-Job": {"schema": {"type": "string"}, "description": "Job of the model."},
            "X-Graings-Iteration": {"schema": {"type": "integer"}, "description": "Iteration of the checkpoint."},
            "X-Graings-Finished": {"schema": {"type": "boolean"}, "description": "false while training continues."},
            "X-Graings-Orbit": {
                "schema": {"type": "string"},
                "description": "azimuth elevation radius of an orbit.",
            },
            "X-Graings-Fast": {
                "schema": {"type": "string"},
                "description": "With fast: how far the approximation is from exact, in px and grey levels.",
            },
            "Server-Timing": {
                "schema": {"type": "string"},
                "description": "Milliseconds of request, queue, scene, raster and encode; a kept image has the first.",
            },
            "X-Time-Clamped": {
                "schema": {"type": "number"},
                "description": "The rendered time, if t was outside [0, 1].",
            },
        },
    },
    304: {"description": "The image has not changed"},
}


class RenderQuery(BaseModel):
    """Parameters of an image. The viewpoint is a view of the capture, an orbit, or a pose; by default an orbit."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    job: str | None = Field(None, max_length=64, description="Job of the model; by default your newest that has one.")
    t: float | None = Field(
        None, description="Time in [0, 1], clamped. Default: that of the view named by `camera`, else 0."
    )
    camera: str | None = Field(None, max_length=40, description="A view of the capture: train:0, val:3, test:12.")
    azimuth: float | None = Field(
        None, description="Orbit: degrees about the vertical (default: the side of the training views)."
    )
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
    width: int | None = Field(None, ge=1, le=MAX_SIDE, description="Pixels; one alone keeps the aspect ratio.")
    height: int | None = Field(None, ge=1, le=MAX_SIDE, description="Pixels.")
    background: str | None = Field(None, max_length=60, description="white, black, #rrggbb or r,g,b in [0, 1].")
    show: Content = Field(
        "color",
        description="color; rgba, transparent where nothing is; alpha; depth, in exr in the capture's units along the "
        "viewing axis, else near white and far grey; layers, for exr: R, G, B, A and depth Z.",
    )
    format: ImageFormat | None = Field(None, description="Instead of the Accept header.")
    fast: bool = Field(
        False,
        description="Approximate the motion, unless the view is too near for that; X-Graings-Fast says by how much. "
        "The first such image takes seconds.",
    )


async def _until_sent() -> AsyncIterator[ExitStack]:
    """What a request holds until its response was sent."""
    with ExitStack() as held:
        yield held


@router.get("/render", operation_id="render", response_class=Response, responses={**_IMAGES, **RESPONSES})
async def render(
    query: Annotated[RenderQuery, Query()],
    context: ContextDep,
    caller: CallerDep,
    held: Annotated[ExitStack, Depends(_until_sent)],
    accept: Annotated[str | None, Header()] = None,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """Render the newest model, or a job's newest checkpoint while it trains, at time `t` from a viewpoint."""
    started = perf_counter()
    format = query.format or _format(accept)
    job_id, loaded = await to_thread.run_sync(_model, context, caller, query.job)
    model = loaded.model
    try:
        check_content(query.show, format)
        view = _view_request(query)
        camera, time, background = view.resolve(model.views, model.units, model.background)
    except ValueError as error:
        raise BadRequest(f"{error}.") from error
    request = RenderRequest(camera, time, background, format, query.show, query.fast)
    headers = {
        "ETag": _etag(model, request),
        "Vary": "Accept",
        # The newest checkpoint changes under the same address: clients revalidate each time, which is cheap.
        "Cache-Control": "private, no-cache",
        "X-Graings-Job": job_id,
        "X-Graings-Iteration": str(model.iteration),
        "X-Graings-Finished": str(model.finished).lower(),
    }
    if query.t is not None and time != query.t:
        headers["X-Time-Clamped"] = f"{time:g}"
    if view.is_orbit:
        headers["X-Graings-Orbit"] = _orbit_header(view, camera, model.units)
    if matches(if_none_match, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    held.enter_context(context.pixel_limit.held(camera.width * camera.height))
    resolved = perf_counter()
    image = await context.pool.render(loaded, request, headers["ETag"])
    if request.fast:
        headers["X-Graings-Fast"] = (await to_thread.run_sync(loaded.fast)).line(camera)
    headers["Server-Timing"] = _server_timing({"request": resolved - started, **image.seconds})
    return Response(image.data, media_type=MEDIA_TYPES[format], headers=headers)


def _server_timing(seconds: Mapping[str, float]) -> str:
    """Milliseconds of each step, in order, as browsers show them."""
    return ", ".join(f"{name};dur={1e3 * duration:.2f}" for name, duration in seconds.items())


def _format(accept: str | None) -> ImageFormat:
    """The offered format that the Accept header prefers, the earlier of `FORMATS` if several are equal."""
    offered = {MEDIA_TYPES[format]: format for format in FORMATS}
    media_type = parse_accept_header(accept or "*/*", MIMEAccept).best_match(offered)
    if media_type is None:
        raise NotAcceptable(f"None of the accepted formats is available. Accept one of {', '.join(offered)}.")
    return offered[media_type]


def _model(context: Context, caller: Caller, job_id: str | None) -> tuple[str, LoadedModel]:
    """The model of a job, or of the newest of the caller's that has one. Blocks."""
    if job_id is not None:
        model = context.models.load(context.store.folder(job_id).run)
        if model is None:
            raise NotYet(f"Job {job_id} has no checkpoint yet. Try again when the job has a render link.")
        return job_id, model
    damaged: CheckpointError | None = None
    for candidate in context.store.ids():
        if not caller.sees(candidate, context.jobs.spec(candidate)):
            continue
        try:
            model = context.models.load(context.store.folder(candidate).run)
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


def _view_request(query: RenderQuery) -> ViewRequest:
    """The view of a query. Raises `ValueError` naming the parameter."""
    pose: dict[str, object] = {name: value for name in _INTRINSICS if (value := getattr(query, name)) is not None}
    if query.pose is not None:
        pose["world_to_camera"] = _matrix(query.pose)
    if pose:
        pose |= {"width": query.width, "height": query.height}
    return ViewRequest(
        camera=query.camera,
        azimuth=query.azimuth,
        elevation=query.elevation,
        radius=query.radius,
        target=None if query.target is None else _numbers(query.target, "target", 3),
        fov=query.fov,
        pose=pose or None,
        width=query.width,
        height=query.height,
        t=query.t,
        background=query.background,
    )


def _matrix(text: str) -> object:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"pose must be a JSON list of four rows of four numbers ({error})") from error


def _orbit_header(view: ViewRequest, camera: Camera, units: Units) -> str:
    """Azimuth, elevation and radius of an orbit, so that a client that gave none can change them."""
    target = units.center if view.target is None else view.target
    arm = camera.center - units.points(target)
    azimuth = azimuths(arm, units.up) if view.azimuth is None else view.azimuth
    return f"{azimuth:.6g} {elevations(arm, units.up):.6g} {np.linalg.norm(arm) / units.scale:.6g}"


def _numbers(text: str, name: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ValueError(f"{name} must be {count} finite numbers with commas between them, got {text!r}")
    return values


def _etag(model: Model, request: RenderRequest) -> str:
    """A hash of everything that the bytes of the image depend on."""
    camera = request.camera
    parts = (
        graings.__version__,
        model.digest,
        camera.world_to_camera.tolist(),
        (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height),
        (request.time, request.background, request.format, request.content, request.fast),
    )
    return f'"{hashlib.sha256(repr(parts).encode()).hexdigest()[:32]}"'
