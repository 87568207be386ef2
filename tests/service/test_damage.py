"""A damaged job does not hide the others, and can be listed and deleted."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from graings.storage.run_folder import CHECKPOINTS
from jobs.engine import Engine
from jobs.job import JobError
from jobs.store import JobFolder
from service.app import create_app
from service.settings import Settings
from tests.service.conftest import queue_job


@pytest.fixture
def second(client: TestClient, job: str, capture: Path, archive: bytes) -> str:
    return queue_job(client, capture, archive, "second")


@pytest.mark.parametrize(
    ("file", "content"),
    [("job.json", "{"), ("job.json", "[]"), ("attempts.json", "{"), ("attempts.json", '[{"x": 1}]')],
)
def test_one_damaged_job_hides_no_other(
    client: TestClient, settings: Settings, job: str, second: str, file: str, content: str
) -> None:
    (settings.data / "jobs" / job / file).write_text(content)
    listed = {entry["id"]: entry for entry in client.get("/jobs").json()["jobs"]}
    assert set(listed) == {job, second}
    assert file in listed[job]["error"]
    assert listed[second]["error"] is None
    assert client.get(f"/jobs/{job}").status_code == 200
    assert client.delete(f"/jobs/{second}").status_code == 204
    assert client.delete(f"/jobs/{job}").status_code == 204
    assert client.get("/jobs").json()["jobs"] == []
    assert list((settings.data / "captures").iterdir()) == []


@pytest.mark.parametrize("line", ["{}", '{"phase": 3}', '{"phase": "joint", "iteration": "many"}'])
def test_an_invalid_report_is_ignored(client: TestClient, settings: Settings, job: str, line: str) -> None:
    (settings.data / "jobs" / job / "progress.jsonl").write_text(line + "\n")
    assert client.get(f"/jobs/{job}").json()["progress"] is None


def test_a_service_starts_with_damaged_jobs_and_other_files(settings: Settings, archive: bytes) -> None:
    with TestClient(create_app(settings)) as client:
        damaged, whole = (client.post("/jobs", content=archive).json()["id"] for _ in range(2))
    (settings.data / "jobs" / ".DS_Store").write_text("")
    (settings.data / "jobs" / damaged / "job.json").unlink()
    for file in settings.data.glob("*.sqlite*"):
        file.unlink()  # the queue has no entry of either job
    with TestClient(create_app(settings)) as client:
        states = {entry["id"]: entry["state"] for entry in client.get("/jobs").json()["jobs"]}
        assert states == {damaged: "failed", whole: "queued"}
        refused = client.post(f"/jobs/{damaged}/retry")
        assert refused.status_code == 409
        assert "delete it" in refused.json()["detail"]
        assert client.delete(f"/jobs/{damaged}").status_code == 204


def test_a_job_that_cannot_be_queued_leaves_no_files(
    client: TestClient, settings: Settings, archive: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unavailable(*_: object) -> None:
        raise JobError("The job database does not answer. Start it.")

    monkeypatch.setattr(Engine, "enqueue", unavailable)
    answer = client.post("/jobs", content=archive)
    assert answer.status_code == 503
    assert "Start it" in answer.json()["detail"]
    assert client.get("/jobs").json()["jobs"] == []
    assert list((settings.data / "captures").iterdir()) == []


def test_a_missing_image_is_restored_by_the_same_upload(
    client: TestClient, settings: Settings, job: str, archive: bytes
) -> None:
    images = sorted((settings.data / "captures").rglob("*.png"))
    images[0].unlink()
    assert client.post("/jobs", content=archive).status_code == 202
    assert sorted((settings.data / "captures").rglob("*.png")) == images


def test_a_job_whose_checkpoints_were_removed_is_rendered_from_its_compact_model(
    client: TestClient, folder: JobFolder, model: str
) -> None:
    before = client.get(f"/render?job={model}&t=0.5", headers={"accept": "image/png"})
    shutil.rmtree(folder.run / CHECKPOINTS)
    after = client.get(f"/render?job={model}&t=0.5", headers={"accept": "image/png"})
    assert (before.status_code, after.status_code) == (200, 200)
    assert after.headers["X-Graings-Iteration"] == before.headers["X-Graings-Iteration"]
    assert client.get(f"/jobs/{model}").json()["links"]["render"] == f"/render?job={model}"
