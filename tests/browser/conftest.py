"""A headless Chromium, with WebGL2 in software, and pages that fail their test for whatever they should not do.

Chromium is the one of the system: `chromium`, `chromium-browser` or `google-chrome`. Without it, or without playwright,
the tests of this folder are skipped. All are slow: drawing without a GPU takes a tenth of a second for each picture.
"""

from __future__ import annotations

import asyncio
import hashlib
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from graings.config import make_config
from jobs.job import JobSpec
from jobs.store import JobFolder
from service.app import create_app
from service.context import Context
from service.settings import Settings
from tests.service.conftest import archive, capture, empty_data, settings, trained  # noqa: F401
from tests.service.test_commands import LONG_S, readiness

playwright = pytest.importorskip("playwright.sync_api")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# Without a sandbox, which needs privileges that containers do not have; the pages are our own.
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
WAIT_MS = 120_000

OpenPage = Callable[..., Any]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.slow(reason="draws in a browser without a GPU"))
            if CHROMIUM is None:
                item.add_marker(pytest.mark.skip(reason="needs a browser: apt-get install chromium"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A browser. It ends with its module: while the driver is open, an event loop runs in the thread of the tests."""
    with playwright.sync_playwright() as driver:
        running = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield running
        running.close()
    with pytest.raises(RuntimeError, match="no running event loop"):
        asyncio.get_running_loop()


@pytest.fixture
def open_page(browser: Any) -> Iterator[OpenPage]:
    """Opens pages. In the end it fails where one had an error, or sent a request to another place than its own.

    Requests with `may_fail` in their address may be refused.
    """
    problems: list[str] = []
    contexts: list[Any] = []

    def opened(address: str, may_fail: str | None = None, **context: Any) -> Any:
        contexts.append(browser.new_context(**context))
        page = contexts[-1].new_page()
        page.set_default_timeout(WAIT_MS)

        def said(message: Any) -> None:
            url = message.location["url"]
            expected = may_fail is not None and may_fail in url and "status of" in message.text
            if message.type in ("error", "warning") and not expected:
                problems.append(f"{message.text} {url}")

        page.on("console", said)
        page.on("pageerror", lambda error: problems.append(str(error)))
        file = address.startswith("file:")
        own = (address.split("#")[0] if file else "/".join(address.split("/")[:3]), "blob:")
        page.on("request", lambda sent: sent.url.startswith((*own, "data:")) or problems.append(sent.url))
        page.goto(address)
        return page

    yield opened
    for context in contexts:
        context.close()
    assert problems == []


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a service with a worker, as processes of their own."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    data = tmp_path_factory.mktemp("data")
    command = [sys.executable, "-m", "service.commands", "--with-worker", "--data", str(data), "--port", str(port)]
    deadline = time.monotonic() + 3 * LONG_S
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            while readiness(port).get("workers") != 1:
                assert process.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.1)
            yield f"http://127.0.0.1:{port}"
        finally:
            process.terminate()


@dataclass(frozen=True, slots=True)
class IdleService:
    """A service without a worker, in this process: jobs keep the state that a test sets."""

    url: str
    context: Context
    capture: Path
    run: Path

    def submit(self, name: str, *, model: bool = False) -> str:
        """The id of a job in the queue, or of a cancelled one with a model."""
        digest = hashlib.sha256(name.encode()).hexdigest()
        spec = JobSpec(name, digest, make_config("draft").model_dump(mode="json"))
        unpacked = Path(shutil.copytree(self.capture, self.context.store.uploads / name))
        job_id = str(self.context.jobs.submit(spec, unpacked).id)
        if model:
            shutil.copytree(self.run, JobFolder(self.context.settings.data / "jobs" / job_id).run)
            self.context.jobs.cancel(job_id)
        return job_id


@pytest.fixture
def idle(
    request: pytest.FixtureRequest,
    settings: Settings,  # noqa: F811
    capture: Path,  # noqa: F811
    trained: Path,  # noqa: F811
) -> Iterator[IdleService]:
    """A service without a worker. Changed settings come from the parameters of a test."""
    app = create_app(settings.model_copy(update=getattr(request, "param", {})))
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_config=None, timeout_graceful_shutdown=1, lifespan="on"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    yield IdleService(f"http://127.0.0.1:{port}", app.state.context, capture, trained)
    server.should_exit = True
    thread.join()
