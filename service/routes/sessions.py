"""Routes of access: a session of a browser in place of a key, and links that show one job."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import BaseModel, Field

from service.access import COOKIE, BearerDep, CallerDep, SessionDep, identify
from service.context import ContextDep, JobId
from service.keys import SESSION_S, Key, Scope
from service.problems import RESPONSES, NotYet, Unauthorized

# The routes of the session check their caller themselves.
open_router = APIRouter(prefix="/session", tags=["access"], responses=RESPONSES)
router = APIRouter(prefix="/jobs/{job_id}/links", tags=["access"], responses=RESPONSES)


class SessionResource(BaseModel):
    """Who a request comes from."""

    name: str | None = Field(description="Name of the key; null where no key is needed.")
    scope: Scope = Field(description="What it allows.")
    job: str | None = Field(description="The only job that it shows, for a link; null otherwise.")


class LinkResource(BaseModel):
    """A link with which anybody can look at one job."""

    id: str = Field(description="Names the link to revoke it.")
    name: str = Field(description="For whom it is.")
    created_at: datetime = Field(description="When it was made.")
    used_at: datetime | None = Field(description="When it was last used, to a minute; null if never.")
    address: str | None = Field(None, description="The page that shows the job. Only in the answer that made the link.")


@open_router.get("", operation_id="get_session")
def get_session(request: Request, context: ContextDep, header: BearerDep, session: SessionDep) -> SessionResource:
    """The name and the scope of the key or session of this request."""
    key = identify(request, context, header.credentials if header else session).key
    if key is None:
        return SessionResource(name=None, scope=Scope.ADMIN, job=None)
    return SessionResource(name=key.name, scope=key.scope, job=key.job)


@open_router.post("", status_code=204, operation_id="begin_session")
def begin_session(request: Request, response: Response, context: ContextDep, header: BearerDep) -> None:
    """Turn a key, or the secret of a link, into a cookie: images and event streams of a page cannot send a header."""
    key = context.keys.find(header.credentials) if header else None
    if key is None or key.kind == "session":
        raise Unauthorized(header is not None)
    with context.request_limits.counted(key.counted_as):
        context.keys.discard_expired()
        _, secret = context.keys.create(key.name, key.scope, "session", parent=key.id, job=key.job)
    secure = request.url.scheme == "https"
    response.set_cookie(COOKIE, secret, max_age=int(SESSION_S), httponly=True, samesite="strict", secure=secure)


@open_router.delete("", status_code=204, operation_id="end_session")
def end_session(response: Response, context: ContextDep, session: SessionDep) -> None:
    """Sign out: the session is refused from now on."""
    key = context.keys.find(session) if session else None
    if key is None or key.kind != "session":  # a link or a key is not the caller's to revoke
        raise Unauthorized(session is not None)
    context.keys.revoke(key)
    response.delete_cookie(COOKIE)


@router.post("", status_code=201, operation_id="create_link")
def create_link(
    job_id: JobId,
    context: ContextDep,
    caller: CallerDep,
    name: Annotated[str, Query(min_length=1, max_length=120, description="For whom the link is.")] = "link",
) -> LinkResource:
    """Make a link with which anybody can look at this job, and at nothing else, until it is revoked."""
    context.jobs.get(job_id)
    key, secret = context.keys.create(name, Scope.VIEW, "link", parent=caller.owner, job=job_id)
    # After a #, a browser neither sends the secret with the request nor passes it on as the referrer.
    return _link(key).model_copy(update={"address": f"/#link={secret}"})


@router.get("", operation_id="list_links")
def list_links(job_id: JobId, context: ContextDep) -> list[LinkResource]:
    """The links that show this job."""
    context.jobs.get(job_id)
    return [_link(key) for key in context.keys.all() if key.kind == "link" and key.job == job_id]


@router.delete("/{link_id}", status_code=204, operation_id="revoke_link")
def revoke_link(job_id: JobId, link_id: Annotated[str, Path(max_length=64)], context: ContextDep) -> None:
    """Revoke a link, with the sessions of all who opened it."""
    key = context.keys.get(link_id)
    if key is None or key.kind != "link" or key.job != job_id:
        raise NotYet(f"This job has no link {link_id!r}. GET /jobs/{job_id}/links lists them.")
    context.keys.revoke(key)


def _link(key: Key) -> LinkResource:
    return LinkResource.model_validate(key, from_attributes=True)
