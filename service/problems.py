"""Problems: every error of the service as a problem document (RFC 9457).

One table says which error has which status. Knows nothing of what went wrong.
"""

from __future__ import annotations

import errno
import json
import logging
from http import HTTPStatus
from typing import Any, ClassVar

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import Response

from graings.errors import CaptureError, CheckpointError, ConfigError, GraingsError, KernelError
from jobs.job import JobConflict, JobDamaged, JobError, JobNotFound

LOG = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
_TYPES = "urn:graings:problem:"


class Problem(BaseModel):
    """A problem document; `type` is about:blank where the status says it all."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str | None = None
    instance: str | None = None
    errors: list[dict[str, Any]] | None = Field(None, description="What is wrong with which parameter.")


class ServiceError(Exception):
    """Root of what only the service knows to be wrong."""

    headers: ClassVar[dict[str, str] | None] = None


class BadRequest(ServiceError):
    """A parameter is out of range or contradicts another."""


class ArchiveError(ServiceError):
    """An upload is not an archive that may be unpacked here."""


class TooLarge(ServiceError):
    """A body is larger than the service takes."""

    headers: ClassVar[dict[str, str] | None] = {"Connection": "close"}  # the rest of the body will not be read


class NotYet(ServiceError):
    """A thing that a job will have later."""


class NotAcceptable(ServiceError):
    """No format on offer is one that the client takes."""


class Busy(ServiceError):
    """Too many wait already."""

    headers: ClassVar[dict[str, str] | None] = {"Retry-After": "1"}


# The first class that fits counts.
STATUSES: tuple[tuple[type[Exception], int, str], ...] = (
    (JobNotFound, 404, "no-such-job"),
    (JobConflict, 409, "state-conflict"),
    (JobDamaged, 500, "job-damaged"),
    (JobError, 503, "jobs-unavailable"),
    (BadRequest, 422, "bad-parameter"),
    (ArchiveError, 422, "capture-rejected"),
    (TooLarge, 413, "too-large"),
    (NotYet, 404, "not-yet"),
    (NotAcceptable, 406, "not-acceptable"),
    (ClientDisconnect, 400, "disconnected"),
    (Busy, 503, "busy"),
    (ConfigError, 422, "bad-config"),
    (CaptureError, 422, "bad-capture"),
    (CheckpointError, 500, "bad-checkpoint"),
    (KernelError, 500, "kernel"),
    (GraingsError, 500, "graings"),
)

# What is away for a while may be asked for again after some seconds.
AWAY = {"Retry-After": "5"}

# What to say where a framework says no more than the status.
_REMEDIES = {
    404: "There is nothing at this address. /docs lists every address there is.",
    405: "This address does not take that method; the header Allow names those it takes.",
}

RESPONSES: dict[int | str, dict[str, Any]] = {
    "4XX": {
        "description": "What is wrong with the request",
        "content": {MEDIA_TYPE: {"schema": Problem.model_json_schema()}},
    },
    "5XX": {
        "description": "What is wrong with the service",
        "content": {MEDIA_TYPE: {"schema": Problem.model_json_schema()}},
    },
}


def problem(
    request: Request,
    status: int,
    detail: str | None = None,
    *,
    kind: str | None = None,
    errors: list[dict[str, Any]] | None = None,
    headers: dict[str, str] | None = None,
) -> Response:
    """A problem document as a response."""
    document = Problem(
        type="about:blank" if kind is None else _TYPES + kind,
        title=HTTPStatus(status).phrase,
        status=status,
        detail=detail,
        instance=request.url.path,
        errors=errors,
    )
    text = json.dumps(document.model_dump(exclude_none=True), ensure_ascii=False, allow_nan=False)
    # What the client sent may hold halves of characters, as "\\ud800" in JSON; to quote them must not fail.
    return Response(text.encode("utf-8", "replace"), status, media_type=MEDIA_TYPE, headers=headers)


def install(app: FastAPI) -> None:
    """Have every error of `app` answered with a problem document."""

    async def known(request: Request, error: Exception) -> Response:
        status, kind = next((status, kind) for cls, status, kind in STATUSES if isinstance(error, cls))
        if status >= 500 and status != 503:
            LOG.error("%s %s: %s", request.method, request.url.path, error)
        headers = error.headers if isinstance(error, ServiceError) else None
        if status == 503 and headers is None:
            headers = AWAY
        return problem(request, status, str(error), kind=kind, headers=headers)

    async def http(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        phrase = HTTPStatus(error.status_code).phrase
        detail = _REMEDIES.get(error.status_code) if error.detail == phrase else str(error.detail)
        return problem(request, error.status_code, detail, headers=dict(error.headers) if error.headers else None)

    async def validation(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        # Without the offending input: it may be large, secret or NaN.
        errors = [{"loc": list(e["loc"]), "msg": e["msg"], "type": e["type"]} for e in error.errors()]
        detail = "; ".join(f"{'.'.join(str(part) for part in e['loc'][1:])}: {e['msg']}" for e in error.errors())
        return problem(request, 422, detail, kind="bad-parameter", errors=errors)

    async def disk(request: Request, error: Exception) -> Response:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return problem(request, 507, "The disk of the service is full.", kind="disk-full")
        return await unforeseen(request, error)

    async def unforeseen(request: Request, error: Exception) -> Response:
        LOG.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return problem(request, 500, "The service made a mistake; its log has the details.")

    for cls, _, _ in STATUSES:
        app.add_exception_handler(cls, known)
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(RequestValidationError, validation)
    app.add_exception_handler(OSError, disk)
    # Starlette puts its own catch-all outside of everything and raises again after answering; a server then drops
    # the connection. One inside answers and is done.
    app.add_middleware(_CatchAll, answer=unforeseen)


class _CatchAll:
    """Answers whatever nobody foresaw, as long as no response has begun."""

    def __init__(self, app: Any, answer: Any) -> None:
        self._app = app
        self._answer = answer

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun = False

        async def watched(message: Any) -> None:
            nonlocal begun
            begun = begun or message["type"] == "http.response.start"
            await send(message)

        try:
            await self._app(scope, receive, watched)
        except Exception as error:
            if begun:
                raise
            response = await self._answer(Request(scope, receive), error)
            await response(scope, receive, send)
