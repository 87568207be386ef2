"""A service on a SQLite database in a temporary folder, without a worker: jobs keep the state that a test sets."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from graings.capture.synthetic import write_synthetic
from graings.config import make_config
from graings.training.run import TrainingRun
from jobs.store import JobFolder
from service.app import create_app
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


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(
        data=tmp_path / "data",
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


@pytest.fixture
def job(client: TestClient, archive: bytes) -> str:
    """A job in the queue."""
    answer = client.post("/jobs", params={"preset": "draft", "name": "moving"}, content=archive)
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


@pytest.fixture
def folder(client: TestClient, settings: Settings, job: str) -> JobFolder:
    """The files of that job."""
    return JobFolder(settings.data / "jobs" / job)


@pytest.fixture
def model(folder: JobFolder, trained: Path, job: str) -> str:
    """A job that has a model."""
    shutil.copytree(trained, folder.run)
    return job
