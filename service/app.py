"""The application: routes, middleware, error handlers and their context."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from anyio import to_thread
from fastapi import Depends, FastAPI
from fastapi.staticfiles import StaticFiles
from prometheus_client import CollectorRegistry

import graings
from graings.kernel import use_threads
from graings.player import WEB as PLAYER
from service import problems
from service.access import authorize
from service.admission import Admission
from service.body_limit import BodyLimit
from service.context import MB, open_context
from service.head import Head
from service.routes import captures, export, jobs, plans, render, results, scenes, sessions, system, tasks, uploads
from service.same_origin import SameOrigin
from service.security_headers import SecurityHeaders
from service.settings import Settings
from service.telemetry import ServiceNumbers, Telemetry

_SMALL_BODY = 64 * 1024
_CAMERA_PATH = 4 * MB  # nerfstudio's file of 3 600 frames has 1.4 MB

# A thread that wants to run Python waits for so long before it interrupts another; the default is 5 ms, and a short
# request that meets two images at work would wait for it several times.
SWITCH_S = 0.001


class Service(FastAPI):
    """The application, with the schemas of its errors and the limit of uploads in its description."""

    max_upload_bytes: int

    def openapi(self) -> dict[str, Any]:
        document = super().openapi()
        document["components"]["schemas"].update(problems.SCHEMAS)
        (size,) = (part for part in document["paths"]["/uploads"]["post"]["parameters"] if part["name"] == "bytes")
        size["schema"]["maximum"] = self.max_upload_bytes
        return document


def create_app(settings: Settings) -> FastAPI:
    """The service as an ASGI application; it opens its data folder when it starts."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        use_threads(settings.render_threads)
        sys.setswitchinterval(SWITCH_S)
        app.state.context = await to_thread.run_sync(open_context, settings)
        registry.register(ServiceNumbers(app.state.context))
        try:
            yield
        finally:
            await to_thread.run_sync(app.state.context.close)

    def limit(method: str, path: str) -> int:
        whole = method == "POST" and path in ("/jobs", "/plans", "/captures")
        part = method == "PUT" and path.startswith("/uploads/")
        video = method == "POST" and path.startswith("/jobs/") and path.endswith("/videos")
        return settings.max_upload_mb * MB if whole or part else _CAMERA_PATH if video else _SMALL_BODY

    app = Service(
        title="GrainGS",
        version=graings.__version__,
        summary="See a moving scene from anywhere, at any time, with nothing but a CPU.",
        lifespan=lifespan,
        docs_url=None,  # its own page loads scripts from other sites
        redoc_url=None,
    )
    app.max_upload_bytes = settings.max_upload_mb * MB
    app.add_middleware(BodyLimit, limit=limit)
    app.add_middleware(SameOrigin, allowed_hosts=settings.allowed_host_names)
    problems.install(app)
    # Added last, so that it comes first: a refused request costs next to nothing.
    app.add_middleware(Admission, path="/render", limit=settings.images_at_once + settings.render_waiting)
    app.state.stopping = lambda: False
    app.state.registry = registry = CollectorRegistry(auto_describe=False)
    app.add_middleware(Head)
    app.add_middleware(SecurityHeaders)
    app.add_middleware(Telemetry, registry=registry)
    for routes in (captures, uploads, jobs, plans, results, export, render, scenes, tasks, sessions, system):
        app.include_router(routes.router, dependencies=[Depends(authorize)])
    for routes in (sessions, system):
        app.include_router(routes.open_router)
    app.mount("/web/swagger", StaticFiles(packages=[("fastapi_swagger", "resources")]), name="swagger")
    app.mount("/web/player", StaticFiles(directory=PLAYER), name="player")
    app.mount("/web", StaticFiles(directory=system.WEB), name="web")
    return app
