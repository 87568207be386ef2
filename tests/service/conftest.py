"""A service on a SQLite database in a temporary folder, without a worker: jobs keep the state that a test sets."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from graings.training.run import TrainingRun
from jobs.job import JobSpec
from jobs.store import JobFolder
from service.app import create_app
from service.context import open_context
from service.settings import Settings

SIZE = 24
ITERATIONS = 12


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic(tmp_path_factory.mktemp("synthetic") / "capture", frames=6, size=SIZE)


@pytest.fixture(scope="session")
def archive(capture: Path) -> bytes:
    return Path(shutil.make_archive(str(capture), "zip", capture)).read_bytes()


@pytest.fixture(scope="session")
def trained(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder after a short training."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    config = make_config("draft", {"iterations": ITERATIONS, "init.points": 200, "threads": 1})
    assert [report.iteration for report in TrainingRun.create(capture, folder, config)][-1] == ITERATIONS
    return folder


@pytest.fixture(scope="session")
def empty_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data folder of a service that was started once: creating its database takes a tenth of a second."""
    folder = tmp_path_factory.mktemp("empty") / "data"
    open_context(Settings(data=folder)).close()
    return folder


@pytest.fixture
def settings(tmp_path: Path, empty_data: Path) -> Settings:
    return Settings(
        data=shutil.copytree(empty_data, tmp_path / "data"),
        max_upload_mb=1,
        max_unpacked_mb=2,
        max_files=100,
        min_free_mb=0,
        allowed_hosts="testserver",
    )


@pytest.fixture
def client(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


def queue_job(client: TestClient, capture: Path, archive: bytes, name: str) -> str:
    """The id of a job as an upload of `archive` leaves it; saves the process that each client starts to inspect one."""
    context = client.app.state.context  # type: ignore[attr-defined]
    spec = JobSpec(name, hashlib.sha256(archive).hexdigest(), make_config("draft").model_dump(mode="json"))
    job = context.jobs.submit(spec, Path(shutil.copytree(capture, context.store.uploads / name)))
    return str(job.id)


@pytest.fixture
def job(client: TestClient, capture: Path, archive: bytes) -> str:
    """A job in the queue."""
    return queue_job(client, capture, archive, "moving")


@pytest.fixture
def folder(client: TestClient, settings: Settings, job: str) -> JobFolder:
    """The files of that job."""
    return JobFolder(settings.data / "jobs" / job)


@pytest.fixture
def model(folder: JobFolder, trained: Path, job: str) -> str:
    """A job that has a model."""
    shutil.copytree(trained, folder.run)
    return job
