"""Problems: every error of the service as a problem document (RFC 9457), with one table of errors and statuses."""

from __future__ import annotations

import errno
import json
import logging
import math
import time
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from types import MappingProxyType
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field
from pydantic.json_schema import models_json_schema
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.routing import Match, Mount

from graings.errors import CaptureError, CheckpointError, ConfigError, GraingsError, KernelError, printable
from jobs.job import CaptureNotFound, JobConflict, JobDamaged, JobError, JobNotFound, OtherSubmission
from jobs.task import TaskNotFound

LOG = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
_TYPES = "urn:graings:problem:"


class WrongParameter(BaseModel):
    """A parameter that was refused."""

    loc: list[str | int] = Field(description="Where it is.")
    msg: str = Field(description="What is wrong with it.")
    type: str = Field(description="Names the kind of error.")


class Problem(BaseModel):
    """A problem document; `type` is about:blank if there is no more specific type than the status."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str | None = None
    instance: str | None = None
    errors: list[WrongParameter] = Field([], description="The wrong parameters and what is wrong with each.")


class ServiceError(Exception):
    """Base class of the errors of the service itself. Its message is `printable`."""

    headers: Mapping[str, str] = MappingProxyType({})

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class Unauthorized(ServiceError):
    """The request has no key, or a wrong one."""

    def __init__(self, wrong: bool) -> None:
        super().__init__(
            "This key or session is wrong, revoked or expired. `graings keys list` on the machine of the service shows "
            "the valid ones."
            if wrong
            else "This needs a key: send Authorization: Bearer KEY. `graings keys create` on the machine of the "
            "service makes one."
        )
        self.headers = {"WWW-Authenticate": 'Bearer realm="graings"' + ', error="invalid_token"' * wrong}


class Forbidden(ServiceError):
    """The key is right, but does not allow this."""

    def __init__(self, message: str, needed: str) -> None:
        super().__init__(message)
        self.headers = {"WWW-Authenticate": f'Bearer realm="graings", error="insufficient_scope", scope="{needed}"'}


class TooManyRequests(ServiceError):
    """A key has used up what it may send; `until` is when it may send again, in Unix seconds."""

    def __init__(self, message: str, until: float = 0.0) -> None:
        super().__init__(message)
        self.headers = {"Retry-After": str(max(1, math.ceil(until - time.time())))}


class BadRequest(ServiceError):
    """A parameter is out of range or contradicts another."""


class ArchiveError(ServiceError):
    """An upload is not an archive, or not one that is safe to unpack."""


class TooLarge(ServiceError):
    """A body is larger than the limit."""

    headers = MappingProxyType({"Connection": "close"})  # the rest of the body is not read


class UploadNotFound(ServiceError):
    """There is no such upload, or not one of the caller's."""

    def __init__(self, upload_id: str) -> None:
        super().__init__(f"There is no upload {upload_id}: it has expired, or never was. Begin one: POST /uploads.")


class UploadConflict(ServiceError):
    """A part that does not continue an upload, or a job of one that is not complete."""


class NotYet(ServiceError):
    """A result that the job does not have yet."""


class Busy(ServiceError):
    """The service does as much of this kind as it can."""

    headers = MappingProxyType({"Retry-After": "5"})


class NotAcceptable(ServiceError):
    """The service has no format that the client accepts."""


# The first matching class counts.
STATUSES: tuple[tuple[type[Exception], int, str], ...] = (
    (JobNotFound, 404, "no-such-job"),
    (TaskNotFound, 404, "no-such-task"),
    (CaptureNotFound, 404, "no-such-capture"),
    (JobConflict, 409, "state-conflict"),
    (JobDamaged, 500, "job-damaged"),
    (OtherSubmission, 422, "idempotency-key-reused"),
    (JobError, 503, "jobs-unavailable"),
    (BadRequest, 422, "bad-parameter"),
    (ArchiveError, 422, "capture-rejected"),
    (TooLarge, 413, "too-large"),
    (UploadNotFound, 404, "no-such-upload"),
    (UploadConflict, 409, "upload-conflict"),
    (NotYet, 404, "not-yet"),
    (Unauthorized, 401, "no-key"),
    (Forbidden, 403, "not-allowed"),
    (TooManyRequests, 429, "too-many-requests"),
    (Busy, 503, "busy"),
    (NotAcceptable, 406, "not-acceptable"),
    (ClientDisconnect, 400, "disconnected"),
    (ConfigError, 422, "bad-config"),
    (CaptureError, 422, "bad-capture"),
    (CheckpointError, 500, "bad-checkpoint"),
    (KernelError, 500, "kernel"),
    (GraingsError, 500, "graings"),
)

RETRY_LATER = {"Retry-After": "5"}

# Details for errors of the framework that have none.
_DETAILS = {
    404: "There is nothing at this address. /docs lists all addresses.",
    405: "This address does not accept the method; the header Allow lists the methods that it accepts.",
}

_CONTENT = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
RESPONSES: dict[int | str, dict[str, Any]] = {
    "4XX": {"description": "An error in the request", "content": _CONTENT},
    "5XX": {"description": "An error in the service", "content": _CONTENT},
}
# The schemas that this refers to: the framework knows only those of answers without an error.
SCHEMAS: dict[str, Any] = models_json_schema([(Problem, "serialization")], ref_template="#/components/schemas/{model}")[
    1
]["$defs"]


def problem(
    request: Request,
    status: int,
    detail: str | None = None,
    *,
    kind: str | None = None,
    errors: Sequence[WrongParameter] = (),
    headers: Mapping[str, str] | None = None,
) -> Response:
    """A problem document as a response."""
    document = Problem(
        type="about:blank" if kind is None else _TYPES + kind,
        title=HTTPStatus(status).phrase,
        status=status,
        detail=detail,
        instance=request.url.path,
        errors=list(errors),
    )
    values = document.model_dump(exclude_none=True, exclude=None if errors else {"errors"})
    text = json.dumps(values, ensure_ascii=False, allow_nan=False)
    # A request may contain half of a surrogate pair, as "\\ud800" in JSON, which UTF-8 cannot encode.
    return Response(text.encode("utf-8", "replace"), status, media_type=MEDIA_TYPE, headers=headers)


def install(app: FastAPI) -> None:
    """Make `app` answer every error with a problem document."""

    async def known(request: Request, error: Exception) -> Response:
        status, kind = next((status, kind) for cls, status, kind in STATUSES if isinstance(error, cls))
        if status >= 500 and status != 503:
            # A file name may contain lone surrogates, which a log in UTF-8 cannot.
            message = str(error).encode("utf-8", "backslashreplace").decode()
            LOG.error("%s %s: %s", request.method, request.url.path, message)
        headers = error.headers if isinstance(error, ServiceError) else RETRY_LATER if status == 503 else None
        return problem(request, status, str(error), kind=kind, headers=headers)

    async def http(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        phrase = HTTPStatus(error.status_code).phrase
        detail = _DETAILS.get(error.status_code) if error.detail == phrase else str(error.detail)
        headers = {"Allow": _allowed(request)} if error.status_code == 405 else error.headers
        return problem(request, error.status_code, detail, headers=headers)

    async def validation(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        # Without the offending input: it may be large, secret or NaN.
        errors = [WrongParameter(loc=e["loc"], msg=e["msg"], type=e["type"]) for e in error.errors()]
        detail = "; ".join(f"{'.'.join(str(part) for part in e['loc'][1:])}: {e['msg']}" for e in error.errors())
        return problem(request, 422, detail, kind="bad-parameter", errors=errors)

    async def disk(request: Request, error: Exception) -> Response:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return problem(request, 507, "The disk of the service is full.", kind="disk-full")
        return await unexpected(request, error)

    async def unexpected(request: Request, error: Exception) -> Response:
        LOG.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return problem(request, 500, "An unexpected error in the service; its log has the details.")

    for cls, _, _ in STATUSES:
        app.add_exception_handler(cls, known)
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(RequestValidationError, validation)
    app.add_exception_handler(OSError, disk)
    # Starlette's own handler for all errors raises the error again after its response, and a server then drops the
    # connection. This one does not.
    app.add_middleware(_CatchAll, answer=unexpected)


def _allowed(request: Request) -> str:
    """The methods of an address: the framework names only those of the first route that has it."""

    def match(method: str) -> bool:
        scope = {**request.scope, "method": method}
        return any(
            route.matches(scope)[0] is Match.FULL for route in request.app.routes if not isinstance(route, Mount)
        )

    methods = [method for method in ("GET", "POST", "PUT", "PATCH", "DELETE") if match(method)] or ["GET"]
    return ", ".join(["HEAD", *methods] if "GET" in methods else methods)


class _CatchAll:
    """Middleware that answers unexpected errors as long as no response has started."""

    def __init__(self, app: Any, answer: Any) -> None:
        self._app = app
        self._answer = answer

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = False

        async def watched(message: Any) -> None:
            nonlocal started
            started = started or message["type"] == "http.response.start"
            await send(message)

        try:
            await self._app(scope, receive, watched)
        except Exception as error:
            if started:
                raise
            response = await self._answer(Request(scope, receive), error)
            await response(scope, receive, send)
