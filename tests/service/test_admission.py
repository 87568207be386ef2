"""Requests beyond the limit are refused before any work; others are not affected."""

from __future__ import annotations

import anyio
import httpx2
import pytest
from starlette.types import Message, Receive, Scope, Send

from service.admission import RETRY_AFTER_S, Admission


class Slow:
    """An application whose requests for an image last until `finish` is set."""

    def __init__(self) -> None:
        self.finish = anyio.Event()
        self.started = 0
        self.error: Exception | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["path"] == "/render":
            self.started += 1
            await self.finish.wait()
            if self.error is not None:
                raise self.error
        start: Message = {"type": "http.response.start", "status": 200, "headers": []}
        await send(start)
        await send({"type": "http.response.body", "body": b"image"})


def client_of(app: Slow) -> httpx2.AsyncClient:
    transport = httpx2.ASGITransport(app=Admission(app, path="/render", limit=2), raise_app_exceptions=False)
    return httpx2.AsyncClient(transport=transport, base_url="http://testserver")


def test_a_request_beyond_the_limit_is_refused_and_others_are_not_affected() -> None:
    statuses: list[int] = []

    async def main() -> None:
        app = Slow()
        async with client_of(app) as client, anyio.create_task_group() as group:

            async def send() -> None:
                statuses.append((await client.get("/render")).status_code)

            for _ in range(5):
                group.start_soon(send)
            while len(statuses) < 3:
                await anyio.sleep(0.01)
            assert app.started == 2
            assert (await client.get("/jobs")).status_code == 200
            refused = await client.get("/render")
            assert refused.headers["retry-after"] == str(RETRY_AFTER_S)
            assert refused.json()["type"] == "urn:graings:problem:busy"
            app.finish.set()
        assert statuses == [503] * 3 + [200] * 2

    anyio.run(main)


@pytest.mark.parametrize("error", [None, RuntimeError("broken")])
def test_a_finished_request_makes_room_for_the_next_even_if_it_failed(error: Exception | None) -> None:
    async def main() -> None:
        app = Slow()
        app.error = error
        app.finish.set()
        async with client_of(app) as client:
            for _ in range(4):
                assert (await client.get("/render")).status_code == (200 if error is None else 500)
        assert app.started == 4

    anyio.run(main)
