from __future__ import annotations

import io
import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from graings.storage.compact import read_compact
from jobs.engine import Engine
from jobs.store import JobFolder
from service.app import create_app
from service.settings import Settings
from tests.capture.captures import write_image, write_single


def problem(answer: Any, status: int) -> dict[str, Any]:
    """The problem document of a response."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    document: dict[str, Any] = answer.json()
    assert document["status"] == status
    assert document["title"]
    return document


def remaining_files(settings: Settings) -> list[Path]:
    return [path for part in ("uploads", "captures", "jobs") for path in (settings.data / part).iterdir()]


def test_a_submitted_capture_becomes_a_queued_job(client: TestClient, archive: bytes, settings: Settings) -> None:
    query = {"preset": "draft", "name": "moving", "priority": 3, "config": '{"iterations": 50, "loss.ssim": 0.1}'}
    answer = client.post("/jobs", params=query, content=archive, headers={"Content-Type": "application/zip"})
    assert answer.status_code == 202
    job = answer.json()
    assert answer.headers["location"] == job["links"]["self"] == f"/jobs/{job['id']}"
    assert (job["state"], job["name"], job["priority"], job["attempts"]) == ("queued", "moving", 3, 0)
    assert (job["config"]["iterations"], job["config"]["loss"]["ssim"], job["config"]["preset"]) == (50, 0.1, "draft")
    later = client.get(job["links"]["self"]).json()
    assert later["queued_s"] > job["queued_s"]
    assert later == {**job, "queued_s": later["queued_s"]}
    assert list((settings.data / "uploads").iterdir()) == []


def test_a_form_with_a_file_and_options_does_the_same(client: TestClient, archive: bytes) -> None:
    form = {"config": json.dumps({"iterations": 70, "preset": "long", "loss": {"squared": 3.0}})}
    query = {"config": '{"iterations": 60, "loss": {"ssim": 0.1, "squared": 2.0}}'}
    answer = client.post("/jobs", params=query, files={"capture": archive}, data=form)
    assert answer.status_code == 202, answer.text
    assert (answer.json()["config"]["iterations"], answer.json()["config"]["preset"]) == (70, "long")
    loss = answer.json()["config"]["loss"]
    assert (loss["ssim"], loss["squared"]) == (0.1, 3.0)  # a section in both is joined, not replaced


def test_a_lone_transforms_file_with_its_points_becomes_a_job(client: TestClient, tmp_path: Path) -> None:
    folder = write_single(
        tmp_path / "scan", 10, ply_file_path="points.ply", k1=0.01, frame={"mask_path": "masks/0.png"}
    )
    write_image(folder / "masks/0.png", np.full((40, 64, 1), 255, np.uint8))
    place = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat ascii 1.0\nelement vertex 2\n{place}end_header\n"
    (folder / "points.ply").write_text(header + "0 0 0\n0.1 0 0\n")
    archive = Path(shutil.make_archive(str(tmp_path / "scan"), "zip", tmp_path, "scan"))
    answer = client.post("/jobs", params={"preset": "draft"}, content=archive.read_bytes())
    assert (answer.status_code, answer.json()["state"]) == (202, "queued"), answer.text


@pytest.mark.parametrize(
    ("query", "word"),
    [
        ({"preset": "best"}, "best"),
        ({"config": "{"}, "not JSON"),
        ({"config": "[1]"}, "object"),
        ({"config": '{"iterations": NaN}'}, "NaN"),
        ({"config": '{"iterations": 0}'}, "iterations"),
        ({"config": '{"itrations": 5}'}, "itrations"),
        ({"config": '{"loss": {"ssim": 1e999}}'}, "loss.ssim"),
        ({"config": '{"a":' * 900 + "1" + "}" * 900}, "parts"),
        ({"config": '{"' + "a." * 2_000 + 'a": 1}'}, "parts"),
        ({"priority": "0"}, "priority"),
        ({"name": ""}, "name"),
    ],
)
def test_wrong_options_are_refused_by_their_name(
    client: TestClient, archive: bytes, settings: Settings, query: dict[str, str], word: str
) -> None:
    assert word in problem(client.post("/jobs", params=query, content=archive), 422)["detail"]
    assert remaining_files(settings) == []


def test_wrong_options_in_a_form_are_refused_without_remaining_files(
    client: TestClient, archive: bytes, settings: Settings
) -> None:
    for form in ({"config": "{"}, {"config": '{"iterations": -1}'}, {"config": "[" * 200_000}):
        problem(client.post("/jobs", files={"capture": archive}, data=form), 422)
    assert "capture" in problem(client.post("/jobs", files={"file": archive}), 422)["detail"]
    assert remaining_files(settings) == []


def test_a_bad_archive_is_refused_without_remaining_files(client: TestClient, settings: Settings) -> None:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        archive.writestr("good.json", "{}")
        archive.writestr("../evil.json", "{}")
    document = problem(client.post("/jobs", content=memory.getvalue()), 422)
    assert document["type"] == "urn:graings:problem:capture-rejected"
    problem(client.post("/jobs", content=b"hello"), 422)
    problem(client.post("/jobs"), 422)
    assert remaining_files(settings) == []


def repacked(archive: bytes, change: Callable[[str, bytes], bytes | None]) -> bytes:
    """The archive with each file replaced by the result of `change`, without those for which it is None."""
    memory = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as source, zipfile.ZipFile(memory, "w") as target:
        for name in source.namelist():
            if not name.endswith("/") and (content := change(name, source.read(name))) is not None:
                target.writestr(name, content)
    return memory.getvalue()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda name, content: None if "train/r_0" in name else content, "train/r_000"),
        (
            lambda name, content: content.replace(b"camera_angle_x", b"angle") if "json" in name else content,
            "transforms",
        ),
        (lambda name, content: content if name.endswith("r_000.png") else None, "the archive"),
    ],
    ids=["images are missing", "a camera is missing", "only images"],
)
def test_a_capture_that_cannot_be_trained_on_is_refused_at_once(
    client: TestClient, archive: bytes, settings: Settings, change: Callable[[str, bytes], bytes | None], word: str
) -> None:
    document = problem(client.post("/jobs", content=repacked(archive, change)), 422)
    assert document["type"] == "urn:graings:problem:bad-capture"
    assert word in document["detail"]
    assert str(settings.data) not in document["detail"]
    assert remaining_files(settings) == []


def test_the_content_type_of_a_form_is_case_insensitive(client: TestClient, archive: bytes) -> None:
    request = client.build_request("POST", "/jobs", files={"capture": archive})
    request.headers["content-type"] = request.headers["content-type"].replace(
        "multipart/form-data", "Multipart/Form-Data"
    )
    assert client.send(request).status_code == 202


def test_a_body_that_is_too_large_is_refused_with_or_without_a_content_length(
    client: TestClient, settings: Settings
) -> None:
    large = bytes(1_000_001)
    problem(client.post("/jobs", content=large), 413)
    problem(client.post("/jobs", content=iter([large[:600_000], large[:600_000]])), 413)  # chunked
    problem(client.post("/jobs", files={"capture": large}), 413)
    problem(client.post("/jobs/0123456789abcdef/cancel", content=large), 413)
    assert remaining_files(settings) == []


def test_jobs_are_listed_in_pages_newest_first(client: TestClient, archive: bytes) -> None:
    ids = [client.post("/jobs", params={"name": f"n{i}"}, content=archive).json()["id"] for i in range(5)]
    ids_found, path = [], "/jobs?limit=2"
    while path:
        page = client.get(path).json()
        assert len(page["jobs"]) <= 2
        ids_found += [job["id"] for job in page["jobs"]]
        path = page["next"]
    assert ids_found == sorted(ids, reverse=True)
    problem(client.get("/jobs?limit=0"), 422)
    problem(client.get("/jobs?cursor=../x"), 422)


def test_cancel_resume_and_retry_depend_on_the_state_and_may_be_repeated(client: TestClient, job: str) -> None:
    def post(verb: str) -> Any:
        return client.post(f"/jobs/{job}/{verb}")

    for verb in ("resume", "retry"):  # it is queued already
        assert (post(verb).status_code, post(verb).json()["state"]) == (202, "queued")
    for _ in range(2):
        assert (post("cancel").status_code, post("cancel").json()["state"]) == (202, "cancelled")
    assert "resume" in problem(post("retry"), 409)["detail"]
    assert "resume" in client.get(f"/jobs/{job}").json()["links"]
    assert post("resume").json()["state"] == "queued"
    assert client.delete(f"/jobs/{job}").status_code == 204
    for answer in (client.get(f"/jobs/{job}"), client.delete(f"/jobs/{job}"), post("cancel")):
        problem(answer, 404)


@pytest.mark.parametrize("path", ["", "/metrics", "/log", "/events", "/curve.svg", "/report", "/report.svg", "/model"])
@pytest.mark.parametrize("job_id", ["0123456789abcdef", "..%2f..%2fetc", "x"])
def test_an_unknown_job_is_a_404_everywhere(client: TestClient, job_id: str, path: str) -> None:
    problem(client.get(f"/jobs/{job_id}{path}"), 404)


def test_results_of_an_untrained_job_do_not_exist_yet(client: TestClient, job: str, folder: JobFolder) -> None:
    for path in ("metrics", "curve.svg", "report", "report.svg", "model"):
        assert problem(client.get(f"/jobs/{job}/{path}"), 404)["type"] == "urn:graings:problem:not-yet"
        assert path.split(".")[0] not in client.get(f"/jobs/{job}").json()["links"]


def test_metrics_and_curve_of_a_trained_job(client: TestClient, model: str) -> None:
    links = client.get(f"/jobs/{model}").json()["links"]
    metrics = client.get(links["metrics"])
    assert metrics.json()["schema"] == "graings.metrics/1"
    assert metrics.headers["content-type"] == "application/json"
    report = client.get(links["report"])
    assert report.json()["schema"] == "graings.work_precision/1"
    assert report.headers["content-type"] == "application/json"
    for address in (links["curve"], f"{links['report']}.svg"):
        image = client.get(address)
        assert image.headers["content-type"] == "image/svg+xml"
        assert "<svg" in image.text


def test_the_model_of_a_trained_job_is_a_file_that_renders(client: TestClient, model: str, tmp_path: Path) -> None:
    answer = client.get(client.get(f"/jobs/{model}").json()["links"]["model"])
    assert f'filename="{model}.graings"' in answer.headers["content-disposition"]
    file = tmp_path / "scene.graings"
    file.write_bytes(answer.content)
    assert len(read_compact(file).views["train"]) > 0


def test_the_log_has_its_last_lines(client: TestClient, job: str, folder: JobFolder) -> None:
    assert client.get(f"/jobs/{job}/log").text == ""
    folder.log.write_text("one\ntwo\nthree\n")
    assert client.get(f"/jobs/{job}/log").text == "one\ntwo\nthree\n"
    assert client.get(f"/jobs/{job}/log?tail=2").text == "two\nthree\n"
    problem(client.get(f"/jobs/{job}/log?tail=-1"), 422)


def test_a_job_stored_but_not_queued_is_queued_at_the_next_start(settings: Settings, archive: bytes) -> None:
    with TestClient(create_app(settings)) as client:
        job = client.post("/jobs", content=archive).json()["id"]
    engine = Engine(settings.database_url)
    engine.delete(job)
    assert engine.waiting() == 0
    with TestClient(create_app(settings)):
        assert engine.waiting() == 1
    engine.close()


def test_a_capture_that_a_job_uses_is_trained_on_again_without_sending_it(
    client: TestClient, job: str, settings: Settings
) -> None:
    digest = client.get(f"/jobs/{job}").json()["capture"]
    answer = client.post("/jobs", params={"capture": digest, "preset": "draft", "name": "again"})
    assert answer.status_code == 202, answer.text
    again = answer.json()
    assert (again["capture"], again["name"], again["state"]) == (digest, "again", "queued")
    assert answer.headers["location"] == f"/jobs/{again['id']}"
    assert [path.name for path in (settings.data / "captures").iterdir()] == [digest]
    assert client.delete(f"/jobs/{job}").status_code in (204, 409)


def test_an_unknown_capture_is_not_found_and_leaves_no_job(client: TestClient, job: str) -> None:
    detail = problem(client.post("/jobs", params={"capture": "0" * 64}), 404)
    assert "Send it again" in detail["detail"]
    assert problem(client.post("/jobs", params={"capture": "../jobs"}), 422)
    assert [each["id"] for each in client.get("/jobs").json()["jobs"]] == [job]


def test_options_for_a_capture_that_was_sent_before_are_checked(client: TestClient, job: str) -> None:
    digest = client.get(f"/jobs/{job}").json()["capture"]
    params = {"capture": digest, "config": json.dumps({"capture.nothing": 1})}
    problem(client.post("/jobs", params=params), 422)
