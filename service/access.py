"""Access: which caller may send which request. Every route but the open ones depends on `authorize`.

A caller shows a key in `Authorization: Bearer`, or a browser the session it was given for one. Reading needs the scope
`read` and everything else `train`, except for the operations in `NEEDS`. A job belongs to the key that made it: who has
another key does not see it, unless that was made from this one. Without any key, a service that only this machine can
reach lets everybody do everything.

Dependencies are coroutines here and elsewhere: FastAPI gives every other function a thread, and each of them waits for
a core and for the interpreter.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated, Final

from anyio import to_thread
from fastapi import Depends, Request, Security
from fastapi.routing import APIRoute
from fastapi.security import APIKeyCookie, HTTPAuthorizationCredentials, HTTPBearer

from jobs.job import JobNotFound, JobSpec
from service.context import Context, ContextDep
from service.keys import Key, Scope
from service.problems import Forbidden, Unauthorized
from service.request_limits import Kind
from service.same_origin import SAFE_METHODS

COOKIE: Final = "graings_session"

# Operations that need another scope than their method says.
NEEDS: Final[dict[str, Scope]] = {
    "get_job": Scope.VIEW,
    "list_jobs": Scope.VIEW,
    "get_events": Scope.VIEW,
    "render": Scope.VIEW,
    "get_scene": Scope.VIEW,
    "get_views": Scope.VIEW,
    "get_service_metrics": Scope.ADMIN,
}

_bearer = HTTPBearer(auto_error=False, scheme_name="key", description="A key that `graings keys create` has shown.")
_session = APIKeyCookie(
    name=COOKIE, auto_error=False, scheme_name="session", description="What `POST /session` gives a browser for a key."
)
BearerDep = Annotated[HTTPAuthorizationCredentials | None, Security(_bearer)]
SessionDep = Annotated[str | None, Security(_session)]


@dataclass(frozen=True, slots=True)
class Caller:
    """Who sent a request: a key with its `owner`, the key that its jobs belong to; without a key anybody."""

    key: Key | None = None
    owner: str | None = None

    @property
    def scope(self) -> Scope:
        return Scope.ADMIN if self.key is None else self.key.scope

    def sees(self, job_id: str, spec: JobSpec) -> bool:
        """Whether the job is one of the caller's."""
        if self.key is not None and self.key.job is not None:
            return job_id == self.key.job
        return self.owns(spec.owner)

    @property
    def may_change(self) -> bool:
        """Whether the caller may do more than look at its jobs."""
        return self.scope.includes(Scope.TRAIN)

    def owns(self, owner: str | None) -> bool:
        """Whether what the key `owner` made is the caller's."""
        return self.key is None or self.scope is Scope.ADMIN or owner == self.owner


def identify(request: Request, context: Context, secret: str | None) -> Caller:
    """The caller with this secret. Raises `Unauthorized`."""
    key = None if secret is None else context.keys.find(secret)
    if key is not None:
        return Caller(key, context.keys.root(key))
    # A wrong key is an error everywhere: who sends one does not want to act as anybody.
    if "authorization" in request.headers or not context.is_open:
        raise Unauthorized(secret is not None)
    return Caller()


async def authorize(
    request: Request, context: ContextDep, header: BearerDep, session: SessionDep
) -> AsyncIterator[None]:
    """Let the request pass if its caller may send it; the caller is then `request.state.caller`."""
    caller = await to_thread.run_sync(_permitted, request, context, header, session)
    request.state.caller = caller
    if caller.key is None:
        yield
        return
    kind: Kind = "event streams" if _operation(request) == "get_events" else "requests"
    with context.request_limits.counted(caller.key.counted_as, kind):
        yield


def _permitted(
    request: Request, context: Context, header: HTTPAuthorizationCredentials | None, session: str | None
) -> Caller:
    """The caller, if it may send the request. Reads files."""
    caller = identify(request, context, header.credentials if header else session)
    needed = _needed(request)
    if not caller.scope.includes(needed):
        raise Forbidden(f"This needs a key of scope {needed}, and this one has {caller.scope}.", needed)
    by_session = header is None and caller.key is not None
    # Browsers name the origin of every request that changes something, and SameOrigin compares it with the host.
    if by_session and request.method not in SAFE_METHODS and "origin" not in request.headers:
        raise Forbidden("A session is for pages of this service. Programs send Authorization: Bearer.", needed)
    job_id = request.path_params.get("job_id") or request.query_params.get("job")
    if job_id is not None and not caller.sees(job_id, context.jobs.spec(job_id)):
        raise JobNotFound(job_id)
    return caller


def _needed(request: Request) -> Scope:
    return NEEDS.get(_operation(request), Scope.READ if request.method in SAFE_METHODS else Scope.TRAIN)


def _operation(request: Request) -> str:
    """The name of the operation that the request asks for; empty for a route that has none."""
    route = request.scope.get("route")
    name = route.operation_id if isinstance(route, APIRoute) else None
    return name or ""


async def _caller_of(request: Request) -> Caller:
    caller: Caller = request.state.caller
    return caller


CallerDep = Annotated[Caller, Depends(_caller_of)]
