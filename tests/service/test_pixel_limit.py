"""A few large images cannot fill the memory, and do not keep small ones away."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest
from anyio import to_thread
from starlette.testclient import TestClient

from service.rendering import EncodedImage, RenderPool
from tests.service.test_jobs import problem

LARGE = (8_192, 8_192)


class Renderer:
    """In place of rendering: images whose time is 0 are at work until `finish` is set."""

    def __init__(self) -> None:
        self.finish = threading.Event()
        self.sides: list[tuple[int, int]] = []
        self.error: Exception | None = None

    @contextmanager
    def finished(self) -> Iterator[None]:
        """So that requests end also where a test fails."""
        try:
            yield
        finally:
            self.finish.set()

    async def render(self, pool: RenderPool, loaded: Any, request: Any, key: str) -> EncodedImage:
        self.sides.append((request.camera.width, request.camera.height))
        if request.time == 0:
            await to_thread.run_sync(self.finish.wait, 60)
        if self.error is not None:
            raise self.error
        return EncodedImage(b"image", {})


@pytest.fixture
def renderer(monkeypatch: pytest.MonkeyPatch) -> Renderer:
    renderer = Renderer()

    async def render(pool: RenderPool, loaded: Any, request: Any, key: str) -> EncodedImage:
        return await renderer.render(pool, loaded, request, key)

    monkeypatch.setattr(RenderPool, "render", render)
    return renderer


def ask(client: TestClient, size: tuple[int, int], t: float = 1.0) -> Any:
    return client.get("/render", params={"width": size[0], "height": size[1], "t": t})


def begun(
    client: TestClient, renderer: Renderer, pool: ThreadPoolExecutor, *sizes: tuple[int, int]
) -> list[Future[Any]]:
    """Requests for images that are at work."""
    requests = []
    for number, size in enumerate(sizes, start=1):
        requests.append(pool.submit(ask, client, size, 0.0))
        deadline = time.monotonic() + 60
        while len(renderer.sides) < number:
            assert time.monotonic() < deadline
            time.sleep(0.02)
    return requests


@pytest.mark.parametrize("working", [[LARGE], [(4_096, 4_096)] * 4, [(8_192, 4_096), (3_000, 3_000), (4_500, 4_500)]])
def test_large_images_beyond_the_limit_are_refused_and_small_ones_are_not(
    client: TestClient, model: str, renderer: Renderer, working: list[tuple[int, int]]
) -> None:
    with ThreadPoolExecutor(4) as pool, renderer.finished():
        requests = begun(client, renderer, pool, *working)
        refused = ask(client, (4_096, 4_096))
        assert problem(refused, 503)["type"] == "urn:graings:problem:busy"
        assert int(refused.headers["retry-after"]) >= 1
        for size in ((64, 64), (1_920, 1_080), (2_048, 2_048)):
            assert ask(client, size).status_code == 200
        renderer.finish.set()
        assert [request.result().status_code for request in requests] == [200] * len(working)
    assert ask(client, LARGE).status_code == 200


@pytest.mark.parametrize("error", [None, RuntimeError("broken")])
def test_a_finished_image_makes_room_for_the_next_even_if_it_failed(
    client: TestClient, model: str, renderer: Renderer, error: Exception | None
) -> None:
    renderer.error = error
    for _ in range(3):
        assert ask(client, LARGE).status_code == (200 if error is None else 500)


def test_an_image_that_has_not_changed_takes_no_room(client: TestClient, model: str, renderer: Renderer) -> None:
    tag = ask(client, LARGE).headers["etag"]
    with ThreadPoolExecutor(1) as pool, renderer.finished():
        renderer.sides.clear()
        (request,) = begun(client, renderer, pool, LARGE)
        same = client.get("/render", params={"width": 8_192, "height": 8_192, "t": 1.0}, headers={"If-None-Match": tag})
        assert same.status_code == 304
        renderer.finish.set()
        assert request.result().status_code == 200
