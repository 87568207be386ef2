"""Routes of the service itself: options, health, and the page for people."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import FileResponse, Response

from graings.config import options
from service.context import ContextDep
from service.problems import AWAY, RESPONSES, problem
from service.schemas import Readiness

WEB = Path(__file__).resolve().parent.parent / "web"
PAGE_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; style-src 'self'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}

router = APIRouter(tags=["system"])


@router.get("/options", operation_id="get_options")
def all_options() -> dict[str, Any]:
    """Every training option with its default, bounds and a line of help, and the presets."""
    return _options()


@cache
def _options() -> dict[str, Any]:
    return options()


@router.get("/healthz", operation_id="get_health")
async def health() -> dict[str, str]:
    """The process answers."""
    return {"status": "ok"}


@router.get("/readyz", operation_id="get_readiness", response_model=Readiness, responses=RESPONSES)
def readiness(request: Request, here: ContextDep) -> Readiness | Response:
    """The database answers and the disk has room."""
    found = Readiness(ready=True, workers=here.leases.alive(), waiting=here.jobs.waiting(), free_mb=here.free_mb())
    if found.free_mb < here.settings.min_free_mb:
        least = here.settings.min_free_mb
        return problem(
            request, 503, f"{found.free_mb} MB free, at least {least} MB are needed.", kind="disk-full", headers=AWAY
        )
    return found


@router.get("/", include_in_schema=False)
async def page() -> Response:
    """The page for people."""
    return FileResponse(WEB / "index.html", headers=PAGE_HEADERS)
