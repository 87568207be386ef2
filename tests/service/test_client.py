"""The client against a real server: it and its asynchronous twin do the same."""

from __future__ import annotations

import asyncio
import inspect
import os
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx2
import numpy as np
import pytest
import uvicorn

from client import AsyncClient, Client, ClientError, Event, RefusedError
from client.calls import job_name
from client.captures import packed
from jobs.progress import ProgressReport, ProgressWriter
from jobs.store import JobFolder
from service.app import create_app
from service.keys import Keys, Scope
from service.settings import Settings

OTHER_THAN_STANDARD = {"iterations": 12, "init.points": 200}


@pytest.fixture
def server(settings: Settings) -> Iterator[uvicorn.Server]:
    """A running service; its `base` is the address."""
    server = uvicorn.Server(
        uvicorn.Config(create_app(settings), port=0, log_config=None, timeout_graceful_shutdown=1, lifespan="on")
    )
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.01)
    yield server
    server.should_exit = True
    thread.join()


@pytest.fixture
def url(server: uvicorn.Server) -> str:
    return f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"


@pytest.fixture
def remote(url: str) -> Iterator[Client]:
    with Client(url) as client:
        yield client


def test_a_folder_is_packed_sent_and_queued(
    remote: Client, capture: Path, archive: bytes, settings: Settings, tmp_path: Path
) -> None:
    sent: list[tuple[int, int]] = []
    job = remote.submit(capture, preset="draft", config=OTHER_THAN_STANDARD, observe=lambda *a: sent.append(a))
    assert (job.state, job.name, job.progress, job.ended) == ("queued", capture.stem, None, False)
    assert job.document["config"]["iterations"] == 12
    assert sent[-1][0] == sent[-1][1] > 10_000
    (tmp_path / "again.zip").write_bytes(archive)
    again = remote.submit(tmp_path / "again.zip", webhook="https://receiver.example/hook")
    assert (again.name, again.document["webhook"]) == ("again", "https://receiver.example/hook")
    assert again.document["webhook_secret"].startswith("whsec_")
    assert "webhook_secret" not in {k for k, v in remote.job(again.id).document.items() if v}
    assert [job.name for job in remote.jobs(limit=1)] == ["again", capture.stem]
    assert remote.cancel(job.id).state == "cancelled"
    assert remote.resume(job.id).state == "queued"
    remote.delete(job.id)
    with pytest.raises(RefusedError, match="There is no job"):
        remote.job(job.id)


def test_a_submission_whose_answer_is_lost_makes_one_job(url: str, capture: Path) -> None:
    lost: list[httpx2.Request] = []

    class Lossy(httpx2.HTTPTransport):
        def handle_request(self, request: httpx2.Request) -> httpx2.Response:
            response = super().handle_request(request)
            if (request.method, request.url.path) == ("POST", "/jobs") and len(lost) < 2:
                lost.append(request)
                response.close()
                raise httpx2.ReadError("broke", request=request)
            return response

    with Client(url, transport=Lossy()) as client:
        job = client.submit(capture, preset="draft")
        assert [entry.id for entry in client.jobs()] == [job.id]
    assert len(lost) == 2


def test_what_is_refused_leaves_nothing_behind(
    remote: Client, capture: Path, settings: Settings, tmp_path: Path
) -> None:
    """A wrong option is refused before the capture is sent; a wrong capture is not kept."""
    sent: list[int] = []
    for wrong in ({"preset": "nonsense"}, {"config": {"iterations": -1}}):
        with pytest.raises(RefusedError) as refused:
            remote.submit(capture, observe=lambda now, all: sent.append(now), **wrong)  # type: ignore[arg-type]
        assert refused.value.status == 422
    assert sent == []
    (tmp_path / "capture.zip").write_bytes(b"no archive")
    with pytest.raises(RefusedError, match="archive"):
        remote.submit(tmp_path / "capture.zip")
    assert list((settings.data / "resumable").iterdir()) == []
    assert list(remote.jobs()) == []


def test_a_capture_whose_files_have_no_time_is_packed(tmp_path: Path) -> None:
    """Archives and containers that are built to have the same bytes give their files the time 0; zip begins in 1980."""
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "a.png").write_bytes(b"image")
    os.utime(tmp_path / "old" / "a.png", (0, 0))
    with packed(tmp_path / "old") as path, zipfile.ZipFile(path) as archive:
        assert archive.read("a.png") == b"image"


def test_linked_folders_of_a_capture_are_packed(tmp_path: Path) -> None:
    (tmp_path / "elsewhere" / "deep").mkdir(parents=True)
    (tmp_path / "elsewhere" / "deep" / "a.png").write_bytes(b"image")
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "images").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "scene" / "transforms.json").write_text("{}")
    with packed(tmp_path / "scene") as path, zipfile.ZipFile(path) as archive:
        assert archive.namelist() == ["images/deep/a.png", "transforms.json"]
    (tmp_path / "elsewhere" / "again").symlink_to(tmp_path / "scene")
    with pytest.raises(ClientError, match="again"), packed(tmp_path / "scene"):
        pass


@pytest.mark.parametrize(
    ("file", "name"),
    [("scene_2024.05.01/", "scene_2024.05.01"), ("walk.zip", "walk"), ("walk.tar.gz", "walk"), ("a.b.tgz", "a.b")],
)
def test_a_job_has_the_name_of_its_capture(tmp_path: Path, file: str, name: str) -> None:
    (tmp_path / file).mkdir() if file.endswith("/") else (tmp_path / file).touch()
    assert job_name(None, tmp_path / file) == name
    assert job_name("another", tmp_path / file) == "another"


def finish_later(folder: JobFolder, remote: Client, job: str, delay_s: float) -> threading.Thread:
    def finish() -> None:
        time.sleep(delay_s)
        writer = ProgressWriter(folder.progress)
        for iteration in (10, 20):
            writer.write(ProgressReport(phase="joint", iteration=iteration, iterations=20, attempt=1))
        writer.close()
        remote.cancel(job)

    thread = threading.Thread(target=finish)
    thread.start()
    return thread


def test_waiting_follows_the_events_of_a_job(remote: Client, capture: Path, settings: Settings) -> None:
    job = remote.submit(capture, preset="draft").id
    thread = finish_later(JobFolder(settings.data / "jobs" / job), remote, job, 0.5)
    seen: list[Event] = []
    assert remote.wait(job, seen.append).state == "cancelled"
    thread.join()
    assert [event.data["iteration"] for event in seen if event.kind == "progress"] == [10, 20]
    assert [event.kind for event in seen][-1] == "end"
    assert seen[-1].data["state"] == "cancelled"


def test_a_model_is_rendered_and_downloaded(
    remote: Client, capture: Path, settings: Settings, trained: Path, tmp_path: Path
) -> None:
    job = remote.submit(capture, preset="draft").id
    with pytest.raises(RefusedError, match="no checkpoint yet") as refused:
        remote.render(job)
    assert (refused.value.status, refused.value.problem["type"]) == (404, "urn:graings:problem:not-yet")
    (settings.data / "jobs" / job / "run").symlink_to(trained)
    assert remote.render(job, tmp_path / "view.jpg", t=0.5, camera="val:0", width=16)[:2] == b"\xff\xd8"
    pose = np.eye(4)
    pose[2, 3] = 4.0
    pixels = remote.render_array(pose=pose, fx=20, width=12, height=10, background="#ff0000")
    assert (pixels.shape, pixels.dtype) == ((10, 12, 3), np.uint8)
    assert (pixels[0, 0] == (255, 0, 0)).all()
    assert remote.render(target=(0, 0, 0), width=8, format="webp")[:4] == b"RIFF"
    assert remote.download(job, "model", tmp_path / "scene.graings").stat().st_size > 100
    assert not list(tmp_path.glob("*.part"))
    with pytest.raises(ClientError, match=r"curve\.svg"):
        remote.download(job, "picture", tmp_path / "x")


def test_the_asynchronous_client_does_the_same(
    url: str, capture: Path, settings: Settings, trained: Path, tmp_path: Path
) -> None:
    async def use() -> None:
        sent: list[tuple[int, int]] = []
        async with AsyncClient(url) as client:
            job = await client.submit(capture, preset="draft", observe=lambda *a: sent.append(a))
            assert sent[-1][0] == sent[-1][1]
            (settings.data / "jobs" / job.id / "run").symlink_to(trained)
            assert [entry.id async for entry in client.jobs()] == [job.id]
            assert (await client.render_array(job.id, width=8, height=6)).shape == (6, 8, 3)
            await client.download(job.id, "metrics", tmp_path / "metrics.json")
            following = asyncio.create_task(client.wait(job.id))
            await asyncio.sleep(0.2)
            await client.cancel(job.id)
            assert (await following).state == "cancelled"
            with pytest.raises(RefusedError, match="Use resume"):
                await client.retry(job.id)

    asyncio.run(use())


def test_both_clients_have_the_same_methods() -> None:
    def methods(client: type) -> dict[str, list[str]]:
        named = {name: value for name, value in vars(client).items() if not name.startswith("_")}
        return {name: [str(p) for p in inspect.signature(value).parameters.values()] for name, value in named.items()}

    assert methods(Client) == methods(AsyncClient)
    assert {name: method.__doc__ for name, method in vars(Client).items() if name[0] != "_"} == {
        name: method.__doc__ for name, method in vars(AsyncClient).items() if name[0] != "_"
    }


def test_a_key_is_sent_and_a_missing_one_is_an_error(url: str, settings: Settings) -> None:
    secret = Keys(settings.data / "keys").create("me", Scope.TRAIN)[1]
    with Client(url, key=secret) as client:
        assert list(client.jobs()) == []
    with Client(url) as client, pytest.raises(RefusedError, match="needs a key") as refused:
        list(client.jobs())
    assert refused.value.status == 401
    with Client(url) as client, pytest.raises(RefusedError, match="needs a key"):
        list(client.events("0" * 16))


def test_a_busy_service_is_asked_again() -> None:
    answers = iter([429, 503, 200])

    def answer(request: httpx2.Request) -> httpx2.Response:
        return httpx2.Response(next(answers), headers={"Retry-After": "0"}, json={"ready": True})

    with Client(transport=httpx2.MockTransport(answer)) as client:
        assert client.readiness() == {"ready": True}
    busy = httpx2.MockTransport(lambda request: httpx2.Response(503, headers={"Retry-After": "0"}, json={}))
    with Client(transport=busy) as client, pytest.raises(RefusedError, match="503"):
        client.readiness()


def test_a_service_that_does_not_answer_is_an_error_with_its_address() -> None:
    with Client("http://127.0.0.1:9") as client, pytest.raises(ClientError, match=r"127\.0\.0\.1:9 does not answer"):
        client.readiness()


@pytest.mark.parametrize("body", ["<html>Sign in</html>", "[]", "{}", "null", '"text"'])
def test_another_program_at_the_address_is_an_error_with_the_address(body: str, tmp_path: Path) -> None:
    def answer(request: httpx2.Request) -> httpx2.Response:
        return httpx2.Response(200, headers={"Content-Type": "text/html"}, text=body)

    with Client("http://other", transport=httpx2.MockTransport(answer)) as client:
        requests: list[Callable[[], object]] = [
            lambda: list(client.jobs()),
            lambda: client.job("a" * 32),
            lambda: client.render(path=tmp_path / "view.png"),
        ]
        for request in requests:
            with pytest.raises(ClientError, match=r"http://other/.* answers, but not as this service does"):
                request()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["nowhere", "nowhere" * 100])
def test_a_missing_capture_is_named(remote: Client, tmp_path: Path, name: str) -> None:
    with pytest.raises(ClientError, match="nowhere"):
        remote.submit(tmp_path / name)


def test_the_client_imports_neither_torch_nor_graings() -> None:
    code = (
        "import client, sys; print([m for m in ('torch', 'graings', 'jobs', 'service', 'numpy') if m in sys.modules])"
    )
    root = Path(__file__).parents[2]
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root, env={**os.environ})
    assert (found.stdout.strip(), found.returncode) == ("[]", 0), found.stderr
