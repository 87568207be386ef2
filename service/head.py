"""Head: answer HEAD wherever GET works, with the headers of GET."""

from __future__ import annotations

import asyncio

from starlette.types import ASGIApp, Message, Receive, Scope, Send


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

        async def watched(message: Message) -> None:
            await send(message)
            started.set()

        await self._app({**scope, "method": "GET"}, gone, watched)
