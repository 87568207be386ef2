"""Head: answer HEAD wherever GET works, with the headers of GET."""

from __future__ import annotations

import asyncio

from starlette.types import ASGIApp, Message, Receive, Scope, Send

ROUTED = ("route", "path_params")  # what routing adds to a scope, for the middleware outside


class Head:
    """Middleware that runs GET for HEAD; the server leaves out the body. A stream ends after its headers."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        started = asyncio.Event()

        async def gone() -> Message:
            await started.wait()
            return {"type": "http.disconnect"}

        inner = {**scope, "method": "GET"}

        async def watched(message: Message) -> None:
            scope.update({name: inner[name] for name in ROUTED if name in inner})
            await send(message)
            started.set()

        await self._app(inner, gone, watched)
