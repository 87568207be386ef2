"""Evaluations and videos of a job: asked for over HTTP, made by real workers."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from graings.export.video_file import decoded, video_file
from graings.export.video_parts import FRAMES
from jobs.queue import JobQueue
from jobs.store import JobFolder
from jobs.task import MAX_FRAMES
from jobs.task_list import MAX_TASKS
from tests.jobs.test_worker import children, until, working
from tests.service.test_jobs import problem

TINY = {"width": 16, "seconds": 0.25, "fps": 20}
LONG = {"width": 1200, "seconds": 60, "fps": 60, "moves": "camera"}  # minutes of rendering


POSE = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1]


def nerfstudio(**changes: Any) -> dict[str, Any]:
    return {"render_width": 16, "render_height": 16, "camera_path": [{"camera_to_world": POSE, "fov": 50}], **changes}


@pytest.fixture
def jobs(client: TestClient) -> JobQueue:
    queue: JobQueue = client.app.state.context.jobs  # type: ignore[attr-defined]
    return queue


def ask(client: TestClient, address: str, **request: Any) -> dict[str, Any]:
    answer = client.post(address, **request)
    assert answer.status_code == 202, answer.text
    resource: dict[str, Any] = answer.json()
    assert answer.headers["location"] == resource["links"]["self"]
    assert resource["state"] == "queued"
    return resource


def get(client: TestClient, task: dict[str, Any]) -> dict[str, Any]:
    resource: dict[str, Any] = client.get(task["links"]["self"]).json()
    return resource


def ended(client: TestClient, task: dict[str, Any]) -> dict[str, Any]:
    until(lambda: get(client, task)["state"] not in ("queued", "running"))
    return get(client, task)


@pytest.fixture
def finished(client: TestClient, jobs: JobQueue, model: str) -> str:
    """A job that has ended and has a model."""
    jobs.cancel(model)
    return model


def test_an_evaluation_and_a_video_are_made_by_a_worker(client: TestClient, jobs: JobQueue, finished: str) -> None:
    av = pytest.importorskip("av")
    evaluation = ask(client, f"/jobs/{finished}/evaluate")
    video = ask(client, f"/jobs/{finished}/videos", json=TINY)
    assert problem(client.get(f"{video['links']['self']}/video"), 404)["type"].endswith("not-yet")
    before = client.get(f"/jobs/{finished}/metrics").json()["splits"]
    assert "test" not in before
    with working(jobs):
        evaluation, video = ended(client, evaluation), ended(client, video)
    assert (evaluation["state"], evaluation["error"]) == ("succeeded", None)
    after = client.get(evaluation["links"]["metrics"]).json()["splits"]
    assert set(after) == {*before, "test"}
    assert (video["state"], video["error"], video["progress"]) == ("succeeded", None, {"done": 5, "total": 5})
    answer = client.get(video["links"]["video"])
    assert answer.headers["content-type"] == "video/mp4"
    path = jobs.store.root / "downloaded.mp4"
    path.write_bytes(answer.content)
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert [frame.shape for frame in frames] == [(16, 16, 3)] * 5
    listed = client.get(f"/jobs/{finished}/tasks").json()["tasks"]
    assert [task["id"] for task in listed] == [video["id"], evaluation["id"]]  # the newest first
    assert client.delete(video["links"]["self"]).status_code == 204
    assert problem(client.get(video["links"]["self"]), 404)["type"].endswith("no-such-task")
    assert client.delete(f"/jobs/{finished}").status_code == 204


@pytest.mark.slow(reason="two workers start, and a video of a few seconds is rendered")
def test_a_video_goes_on_after_the_death_of_its_worker_and_a_deleted_one_stops(
    client: TestClient, jobs: JobQueue, finished: str
) -> None:
    wanted = {"width": 400, "height": 300, "seconds": 6, "fps": 60}
    video = ask(client, f"/jobs/{finished}/videos", json=wanted)
    with working(jobs) as worker:
        until(lambda: (get(client, video)["progress"] or {}).get("done", 0) > FRAMES)
        worker.send_signal(signal.SIGKILL)
        worker.wait()
    (part,) = (jobs.store.folder(finished).tasks / video["id"] / ".video.mp4.parts").glob("0*")
    with video_file(part, 400, 300, 60.0) as add:  # whether this part is used again shows in its colour
        for _ in range(FRAMES):
            add(np.full((300, 400, 3), (250, 0, 0), np.uint8))
    with working(jobs) as worker:
        assert ended(client, video)["state"] == "succeeded"
        path = jobs.store.root / "downloaded_whole.mp4"
        path.write_bytes(client.get(f"{video['links']['self']}/video").content)
        red = [bool(np.abs(frame.mean((0, 1)) - (250, 0, 0)).max() < 8) for frame in decoded(path)]
        assert red == [True] * FRAMES + [False] * (360 - FRAMES)
        endless = ask(client, f"/jobs/{finished}/videos", json=LONG)
        until(lambda: get(client, endless)["progress"])
        assert len(children(worker.pid, "jobs.task_process")) == 1
        refused = problem(client.delete(f"/jobs/{finished}"), 409)
        assert endless["id"] in refused["detail"]
        assert client.delete(endless["links"]["self"]).status_code == 204
        until(lambda: not children(worker.pid, "jobs.task_process"))
        assert client.delete(f"/jobs/{finished}").status_code == 204


@pytest.mark.parametrize(
    ("request_", "word"),
    [
        ({"camera": "test:99"}, "camera"),
        ({"camera": "test:0"}, "orbit"),  # a path that starts at an orbit
        ({"seconds": 600, "fps": 240}, "frames"),
        ({"path": {"keys": []}}, "keys"),
        ({"path": {"keys": [{"azimuth": 0, "zoom": 2}]}}, "zoom"),
        ({"path": {"camera_path": 3}}, "path"),
        ({"path": nerfstudio(render_width=10**9)}, "render_width"),
        ({"path": nerfstudio(render_height=0)}, "render_height"),
        ({"path": nerfstudio(camera_path=[{"camera_to_world": POSE, "fov": 0}])}, "fov"),
        ({"path": nerfstudio(camera_path=[{"camera_to_world": [0] * 16, "fov": 50}])}, "path"),
        ({"path": {"keys": [[]]}}, "path"),
        ({"path": "spiral"}, "path"),
        ({"background": "mauve"}, "background"),
        ({"width": 0}, "width"),
        ({"width": 1, "format": "mp4"}, "2 x 2"),
        ({"path": nerfstudio(render_width=1), "format": "mp4"}, "2 x 2"),
        ({"fps": -1}, "fps"),
        ({"fps": 120, "format": "gif"}, "fps"),
        ({"path": {"keys": [{"camera": 3, "t": 0}]}}, "keys[0]"),
        ({"path": {"keys": [{"azimuth": 0, "t": 0}]}, "moves": "time"}, "path"),
        ({"zoom": 2}, "zoom"),
    ],
)
def test_a_video_that_cannot_be_made_is_refused_at_once(
    client: TestClient, model: str, request_: dict[str, Any], word: str
) -> None:
    assert word in json.dumps(problem(client.post(f"/jobs/{model}/videos", json=request_), 422))
    assert client.get(f"/jobs/{model}/tasks").json() == {"tasks": []}


def test_a_path_of_keys_is_taken(client: TestClient, model: str) -> None:
    keys = [{"azimuth": 0, "t": 0}, {"azimuth": 90, "t": 1}]
    task = ask(client, f"/jobs/{model}/videos", json={"path": {"keys": keys}})
    assert task["spec"]["path"] == {"keys": keys}


def test_only_a_job_that_has_ended_is_evaluated_and_only_on_views_that_it_has(
    client: TestClient, jobs: JobQueue, model: str
) -> None:
    assert "queued" in problem(client.post(f"/jobs/{model}/evaluate"), 409)["detail"]
    jobs.cancel(model)
    detail = problem(client.post(f"/jobs/{model}/evaluate?split=between"), 422)["detail"]
    assert detail == "split: the capture has no views of between; it holds out val, test."
    assert problem(client.post(f"/jobs/{model}/evaluate?split=train"), 422)


def test_a_job_without_a_model_has_no_tasks(client: TestClient, jobs: JobQueue, job: str) -> None:
    jobs.cancel(job)
    for address in ("evaluate", "videos"):
        assert problem(client.post(f"/jobs/{job}/{address}", json={}), 404)["type"].endswith("not-yet")
    assert problem(client.get(f"/jobs/{job}/tasks/none"), 404)["type"].endswith("no-such-task")
    assert problem(client.get(f"/jobs/{job}/tasks/..%2Frun"), 404)


def test_a_job_keeps_a_limited_number_of_tasks(client: TestClient, model: str) -> None:
    for _ in range(MAX_TASKS):
        task = ask(client, f"/jobs/{model}/videos", json=TINY)
    assert "Delete one" in problem(client.post(f"/jobs/{model}/videos", json=TINY), 409)["detail"]
    assert client.delete(task["links"]["self"]).status_code == 204
    ask(client, f"/jobs/{model}/videos", json=TINY)


@pytest.fixture
def task_folder(client: TestClient, model: str, folder: JobFolder) -> Path:
    return folder.tasks / ask(client, f"/jobs/{model}/videos", json=TINY)["id"]


def test_a_task_that_was_never_queued_says_so(client: TestClient, model: str, task_folder: Path) -> None:
    engine = client.app.state.context.engine  # type: ignore[attr-defined]
    engine.delete(model)  # as if its process had died before it was queued
    task = client.get(f"/jobs/{model}/tasks/{task_folder.name}").json()
    assert (task["state"], task["error"]) == ("failed", "It was not queued. Ask for it again.")


def test_a_damaged_task_hides_no_other_and_can_be_deleted(client: TestClient, model: str, task_folder: Path) -> None:
    other = ask(client, f"/jobs/{model}/videos", json=TINY)
    (task_folder / "task.json").write_text('{"created_at": NaN}')
    address = f"/jobs/{model}/tasks/{task_folder.name}"
    assert problem(client.get(address), 404)["type"].endswith("no-such-task")
    assert [task["id"] for task in client.get(f"/jobs/{model}/tasks").json()["tasks"]] == [other["id"]]
    assert client.delete(address).status_code == 204
    assert not task_folder.exists()


def test_a_task_that_fails_names_no_folder_of_the_service(client: TestClient, jobs: JobQueue, finished: str) -> None:
    evaluation = ask(client, f"/jobs/{finished}/evaluate")
    capture = jobs.store.trained_on(finished)
    (capture / "transforms_test.json").write_text("broken")
    with working(jobs):
        evaluation = ended(client, evaluation)
    assert evaluation["state"] == "failed"
    assert "transforms_test.json" in evaluation["error"]
    assert str(jobs.store.root) not in evaluation["error"]


def test_a_long_path_of_nerfstudio_is_taken_and_one_that_is_too_long_refused(client: TestClient, model: str) -> None:
    """Ten seconds are 90 kB of numbers."""
    frame = {"camera_to_world": POSE, "fov": 50.123456789, "aspect": 1.777777777777}
    path = nerfstudio(camera_path=[frame] * 1_000)
    assert len(json.dumps(path)) > 100_000
    task = ask(client, f"/jobs/{model}/videos", json={"path": path})
    assert len(task["spec"]["path"]["camera_path"]) == 1_000
    many = nerfstudio(camera_path=[frame] * (MAX_FRAMES + 1))
    assert "3601 frames" in problem(client.post(f"/jobs/{model}/videos", json={"path": many}), 422)["detail"]


@pytest.mark.parametrize("chunked", [False, True])
def test_a_body_that_is_too_large_is_called_so_by_a_route_of_json_too(
    client: TestClient, model: str, chunked: bool
) -> None:
    """Whether or not the request says its length: the framework calls a body that ends with an error unreadable."""
    body = b'{"seconds": 2' + b" " * 4_000_000 + b"}"
    content = iter((body[:2_500_000], body[2_500_000:])) if chunked else body
    headers = {"Content-Type": "application/json"}
    refused = client.post(f"/jobs/{model}/videos", content=content, headers=headers)
    assert problem(refused, 413)["type"].endswith("too-large")
