"""SameOrigin: refuse what a page of somebody else has a browser send.

A browser sends a request to a service on its own machine for any page that asks, and says in `Origin` whose page it
was; scripts say nothing. A page may also have its own name lead to this machine (DNS rebinding), and is then of the
same origin by that name; the browser says so in `Host`. Without authentication these two are all that keeps strange
pages from reading, starting and deleting jobs. Knows nothing of what is asked.
"""

from __future__ import annotations

from collections.abc import Collection
from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from service.problems import problem

HARMLESS = ("GET", "HEAD", "OPTIONS")  # change nothing, and what they answer such a page never gets to see
ANY = "*"


class SameOrigin:
    """Middleware: all is asked of a name of this service, and what changes something by a page of it or by none.

    `names` are those it answers to, beside addresses, which nobody else can have lead here; `ANY` stands for all.
    """

    def __init__(self, app: ASGIApp, names: Collection[str]) -> None:
        self._app = app
        self._names = names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            request = Request(scope)
            origin, host = request.headers.get("origin"), request.headers.get("host")
            if host is not None and not self._is_ours(host):
                detail = (
                    f"This service does not answer to the name {host[:80]!r}. "
                    "If it should, add the name to its setting GRAINGS_NAMES."
                )
                await problem(request, 403, detail, kind="foreign-name")(scope, receive, send)
                return
            if (
                request.method not in HARMLESS
                and origin is not None
                and (host is None or urlsplit(origin).netloc.lower() != host.lower())
            ):
                detail = "A page of another site asked for this. Behind a proxy, have it pass on the header Host."
                await problem(request, 403, detail, kind="foreign-page")(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _is_ours(self, host: str) -> bool:
        if ANY in self._names:
            return True
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:  # brackets around what is no address
            return False
        return name in self._names or _is_address(name)


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
