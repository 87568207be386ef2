"""SameOrigin: refuse what a page of somebody else has a browser send.

A browser sends a request to a service on its own machine for any page that asks, and says in `Origin` whose page it
was; scripts say nothing. Without authentication that is all that keeps strange pages from starting and deleting jobs.
Knows nothing of what is asked.
"""

from __future__ import annotations

from urllib.parse import urlsplit

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from service.problems import problem

HARMLESS = ("GET", "HEAD", "OPTIONS")  # change nothing, and what they answer such a page never gets to see


class SameOrigin:
    """Middleware: what changes something comes from a page of this service or from no page at all."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            request = Request(scope)
            origin, host = request.headers.get("origin"), request.headers.get("host", "")
            if (
                request.method not in HARMLESS
                and origin is not None
                and urlsplit(origin).netloc.lower() != host.lower()
            ):
                detail = "A page of another site asked for this. Behind a proxy, have it pass on the header Host."
                await problem(request, 403, detail, kind="foreign-page")(scope, receive, send)
                return
        await self._app(scope, receive, send)
