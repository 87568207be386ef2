"""Admission: refuse requests that would wait too long for an image, before any work is done for them."""

from __future__ import annotations

import asyncio
import random

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from service.problems import problem

# A refusal is sent only about when the client may try again: many do so at once, and hundreds of them would take
# the CPU time of the images. The times are spread, so that they do not all come back together. Waiting costs no thread.
RETRY_AFTER_S = 2


class Admission:
    """Middleware: at most `limit` requests for `path` at a time; a further one is answered with 503."""

    def __init__(self, app: ASGIApp, path: str, limit: int) -> None:
        self._app = app
        self._path = path
        self._limit = limit
        self._admitted = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["path"] != self._path:
            await self._app(scope, receive, send)
            return
        if self._admitted >= self._limit:
            await asyncio.sleep(random.uniform(0.5, 1.5) * RETRY_AFTER_S)
            detail = "Too many images are being rendered. Try again in a moment."
            headers = {"Retry-After": str(RETRY_AFTER_S)}
            await problem(Request(scope), 503, detail, kind="busy", headers=headers)(scope, receive, send)
            return
        self._admitted += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._admitted -= 1
