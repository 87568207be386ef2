"""Routes of the service itself: options, health, and the web page."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from fastapi import APIRouter, Request
from fastapi.responses import FileResponse, PlainTextResponse, Response
from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4, generate_latest

from graings.capture.synthetic import SUITE
from graings.config import options
from service.context import ContextDep
from service.problems import RESPONSES, RETRY_LATER, problem
from service.schemas import OptionsResource, Readiness

WEB = Path(__file__).resolve().parent.parent / "web"

router = APIRouter(tags=["system"])
open_router = APIRouter(tags=["system"])  # for everybody, also without a key


@router.get("/options", operation_id="get_options")
def all_options() -> OptionsResource:
    """Every training option with default, bounds and description, the presets, and the synthetic scenes."""
    return _options()


@cache
def _options() -> OptionsResource:
    scenes = [{"name": scene.name, "question": scene.question} for scene in SUITE]
    return OptionsResource.model_validate({**options(), "scenes": scenes})


@router.get("/metrics", operation_id="get_service_metrics", response_class=PlainTextResponse, responses=RESPONSES)
def metrics(request: Request) -> Response:
    """Numbers of the service for Prometheus: requests, jobs, workers, images, disk."""
    return Response(generate_latest(request.app.state.registry), media_type=CONTENT_TYPE_PLAIN_0_0_4)


@open_router.get("/healthz", operation_id="get_health")
async def health() -> dict[str, str]:
    """The process runs."""
    return {"status": "ok"}


@open_router.get("/readyz", operation_id="get_readiness", response_model=Readiness, responses=RESPONSES)
def readiness(request: Request, context: ContextDep) -> Readiness | Response:
    """The database answers and the disk has room."""
    workers, waiting, free_mb = context.leases.alive(), context.jobs.waiting(), context.free_mb()
    if free_mb < context.settings.min_free_mb:
        detail = f"{free_mb} MB are free in the data folder, {context.settings.min_free_mb} MB are needed. Delete jobs."
        return problem(request, 503, detail, kind="disk-full", headers=RETRY_LATER)
    return Readiness(ready=True, workers=workers, waiting=waiting, free_mb=free_mb)


@open_router.get("/", include_in_schema=False)
async def page() -> Response:
    """The web page."""
    return FileResponse(WEB / "index.html")


@open_router.get("/docs", include_in_schema=False)
async def documentation() -> Response:
    """The page that describes every request and tries it."""
    return FileResponse(WEB / "docs.html")
