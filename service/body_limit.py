"""BodyLimit: refuse request bodies that are too large, with or without a Content-Length."""

from __future__ import annotations

from collections.abc import Callable

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems import TooLarge, problem


class BodyLimit:
    """Middleware: `limit(method, path)` is the greatest number of bytes in the body of such a request."""

    def __init__(self, app: ASGIApp, limit: Callable[[str, str], int]) -> None:
        self._app = app
        self._limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        most = self._limit(request.method, request.url.path)
        message = f"The body may have at most {most} bytes."

        async def refuse() -> None:
            response = problem(request, 413, message, kind="too-large", headers=TooLarge.headers)
            await response(scope, receive, send)

        declared = request.headers.get("content-length", "")
        if declared.isdigit() and int(declared) > most:
            await refuse()
            return
        received, answering = 0, False

        async def counted() -> Message:
            nonlocal received
            part = await receive()
            received += len(part.get("body", b""))
            if received > most:
                raise TooLarge(message)
            return part

        async def watched(message: Message) -> None:
            """The refusal in place of what the application makes of a body that ends with an error."""
            nonlocal answering
            if answering or received <= most:
                answering = True
                await send(message)
            elif message["type"] == "http.response.start":
                await refuse()

        await self._app(scope, counted, watched)
