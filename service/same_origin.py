"""SameOrigin: refuse requests that a page of another site makes a browser send.

A page of any site can make a browser send requests to a service on its own machine; the header `Origin` names that
site, and scripts send none. A site can also resolve its own name to this machine (DNS rebinding), so that its page is
of the same origin; the header `Host` then has that name. On its own machine the service needs no key: these two checks
prevent such pages from reading, starting and deleting jobs.
"""

from __future__ import annotations

from collections.abc import Collection
from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from service.problems import problem

SAFE_METHODS = ("GET", "HEAD", "OPTIONS")  # they change nothing, and a page of another site cannot read the response
ANY_HOST = "*"


class SameOrigin:
    """Middleware: `Host` must be an allowed host, and for a method that changes something `Origin` must be that host.

    `allowed_hosts` are names; IP addresses are always allowed, as DNS cannot redirect them. `ANY_HOST` allows all.
    """

    def __init__(self, app: ASGIApp, allowed_hosts: Collection[str]) -> None:
        self._app = app
        self._allowed_hosts = allowed_hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            request = Request(scope)
            origin, host = request.headers.get("origin"), request.headers.get("host")
            if host is not None and not self._is_allowed(host):
                detail = (
                    f"{host[:80]!r} is not an allowed host of this service. "
                    "If it should be, add it to the setting GRAINGS_ALLOWED_HOSTS."
                )
                await problem(request, 403, detail, kind="host-not-allowed")(scope, receive, send)
                return
            if (
                request.method not in SAFE_METHODS
                and origin is not None
                and (host is None or urlsplit(origin).netloc.lower() != host.lower())
            ):
                detail = "A page of another site sent this request. A proxy must pass on the header Host unchanged."
                await problem(request, 403, detail, kind="cross-origin")(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _is_allowed(self, host: str) -> bool:
        if ANY_HOST in self._allowed_hosts:
            return True
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:  # brackets without an IP address in them
            return False
        return name in self._allowed_hosts or _is_address(name)


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
