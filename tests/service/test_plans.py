"""Plans over HTTP: before a job is queued, and of a job."""

from __future__ import annotations

import json

import pytest
from jsonschema import Draft202012Validator
from starlette.testclient import TestClient

from jobs.store import JobFolder
from service.settings import Settings


def test_a_plan_is_made_without_a_job_and_leaves_nothing_on_disk(
    client: TestClient, archive: bytes, settings: Settings
) -> None:
    options = {"preset": "draft", "config": json.dumps({"scene.residual": False})}
    answer = client.post("/plans", params=options, content=archive, headers={"Content-Type": "application/zip"})
    assert answer.status_code == 200, answer.text
    plan = answer.json()
    assert plan["schema"] == "graings.plan/1"
    assert plan["statistics"]["camera_motion"] == "moving"
    assert {d["component"]: d["kind"] for d in plan["decisions"] if d["decision"] == "drop"}["residual"] == "user"
    assert any("cannot be told" in warning for warning in plan["warnings"])
    assert client.get("/jobs").json()["jobs"] == []
    assert [*(settings.data / "uploads").iterdir(), *(settings.data / "captures").iterdir()] == []
    schema = client.get("/openapi.json").json()
    content = schema["paths"]["/plans"]["post"]["responses"]["200"]["content"]["application/json"]["schema"]
    text = json.dumps({**content, "$defs": schema["components"]["schemas"]}).replace(
        "#/components/schemas/", "#/$defs/"
    )
    Draft202012Validator(json.loads(text)).validate(plan)


@pytest.mark.parametrize(
    ("params", "content", "status"),
    [({"preset": "none"}, b"x", 422), ({}, b"not an archive", 422), ({"config": "{"}, b"x", 422)],
)
def test_a_bad_request_is_refused_as_for_a_job(
    client: TestClient, settings: Settings, params: dict[str, str], content: bytes, status: int
) -> None:
    headers = {"Content-Type": "application/zip"}
    answer = client.post("/plans", params=params, content=content, headers=headers)
    same = client.post("/jobs", params=params, content=content, headers=headers)
    assert answer.status_code == same.status_code == status
    assert answer.json()["detail"] == same.json()["detail"]
    assert list((settings.data / "uploads").iterdir()) == []


def test_a_job_has_a_plan_once_its_training_began(client: TestClient, model: str) -> None:
    job = client.get(f"/jobs/{model}").json()
    plan = client.get(job["links"]["plan"]).json()
    assert plan == client.get(f"/jobs/{model}/metrics").json()["plan"]


def test_a_waiting_job_has_no_plan_yet(client: TestClient, job: str, folder: JobFolder) -> None:
    assert not folder.plan.exists()
    assert "plan" not in client.get(f"/jobs/{job}").json()["links"]
    answer = client.get(f"/jobs/{job}/plan")
    assert answer.status_code in (404, 409)
    assert "POST /plans" in answer.json()["detail"]
