"""The published description of the service: documents have their schemas, and answers are true to them."""

from __future__ import annotations

import json
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from starlette.testclient import TestClient

from graings.report.events import Grew
from jobs.progress import ProgressReport, ProgressWriter
from jobs.store import JobFolder


@pytest.fixture
def openapi(client: TestClient) -> dict[str, Any]:
    document: dict[str, Any] = client.get("/openapi.json").json()
    return document


def answer_schema(openapi: dict[str, Any], path: str) -> dict[str, Any]:
    """The schema of the answer to GET `path`, with all components it refers to."""
    content = openapi["paths"][path]["get"]["responses"]["200"]["content"]
    text = json.dumps({**content["application/json"]["schema"], "$defs": openapi["components"]["schemas"]})
    schema: dict[str, Any] = json.loads(text.replace("#/components/schemas/", "#/$defs/"))
    return schema


@pytest.mark.parametrize("path", ["metrics", "report"])
def test_the_documents_of_a_trained_job_are_valid(
    client: TestClient, openapi: dict[str, Any], model: str, path: str
) -> None:
    schema = answer_schema(openapi, f"/jobs/{{job_id}}/{path}")
    Draft202012Validator(schema).validate(client.get(f"/jobs/{model}/{path}").json())


def test_a_job_with_progress_and_events_is_valid(
    client: TestClient, openapi: dict[str, Any], job: str, folder: JobFolder
) -> None:
    writer = ProgressWriter(folder.progress)
    events = (Grew(iteration=5, anchors=3),)
    writer.write(ProgressReport(phase="joint", iteration=5, iterations=9, attempt=1, events=events))
    writer.close()
    answer = client.get(f"/jobs/{job}").json()
    assert answer["progress"]["events"][0]["message"] == "grew 3 anchors"
    Draft202012Validator(answer_schema(openapi, "/jobs/{job_id}")).validate(answer)


def test_the_stream_of_events_names_the_schemas_of_its_data(openapi: dict[str, Any]) -> None:
    content = openapi["paths"]["/jobs/{job_id}/events"]["get"]["responses"]["200"]["content"]["text/event-stream"]
    data = content["itemSchema"]["properties"]["data"]
    names = [choice["$ref"].rpartition("/")[2] for choice in data["contentSchema"]["anyOf"]]
    assert names == ["ProgressReport", "JobResource"]
    assert set(names) <= openapi["components"]["schemas"].keys()
    kinds = openapi["components"]["schemas"]["ProgressReport"]["properties"]["events"]["items"]["discriminator"]
    assert {"grew", "rolled_back", "restart"} <= kinds["mapping"].keys()


def test_the_limit_of_uploads_is_in_the_document(client: TestClient) -> None:
    parameters = client.get("/openapi.json").json()["paths"]["/uploads"]["post"]["parameters"]
    assert [part["schema"]["maximum"] for part in parameters if part["name"] == "bytes"] == [1_000_000]
    assert client.post("/uploads?bytes=1000000").status_code == 201
    assert client.post("/uploads?bytes=1000001").status_code == 422
