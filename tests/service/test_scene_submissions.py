"""Submitting a synthetic scene in place of a capture."""

from __future__ import annotations

import io
import json
import zipfile

from starlette.testclient import TestClient

from graings.capture.synthetic import RECIPE_FILE
from service.settings import Settings
from tests.service.test_jobs import problem


def recipe(**values: object) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr(RECIPE_FILE, json.dumps(values))
    return data.getvalue()


def test_every_offered_scene_can_be_submitted_by_its_name(client: TestClient, settings: Settings) -> None:
    scenes = [scene["name"] for scene in client.get("/options").json()["scenes"]]
    assert len(scenes) == 12
    for scene in scenes:
        answer = client.post("/jobs", params={"scene": scene, "preset": "draft"})
        assert (answer.status_code, answer.json()["name"]) == (202, scene)
    again = client.post("/jobs", params={"scene": scenes[0], "preset": "fine", "name": "mine"}).json()
    assert (again["name"], again["config"]["preset"]) == ("mine", "fine")
    assert len(list((settings.data / "captures").iterdir())) == 12  # the second job uses the capture of the first
    assert list((settings.data / "uploads").iterdir()) == []


def test_an_unknown_scene_and_two_sources_are_refused(client: TestClient, settings: Settings) -> None:
    refused = problem(client.post("/jobs?scene=walkre"), 422)
    assert "walkre" in refused["detail"]
    assert "walker, crossing" in refused["detail"]
    assert "one of them" in problem(client.post(f"/jobs?scene=walker&capture={'0' * 64}"), 422)["detail"]
    assert list((settings.data / "uploads").iterdir()) == []
    assert client.get("/jobs").json()["jobs"] == []


def test_a_recipe_in_an_archive_has_its_own_size(client: TestClient) -> None:
    assert client.post("/jobs", content=recipe(scene="flag", size=64, views=20)).status_code == 202
    refused = problem(client.post("/jobs", content=recipe(scene="flag", size=64, view=20)), 422)
    assert "view: Extra inputs" in refused["detail"]
    assert '"views": 150' in refused["detail"]


def test_there_is_no_plan_and_no_inspection_of_images_that_are_not_drawn_yet(client: TestClient) -> None:
    for path in ("/plans", "/captures"):
        refused = problem(client.post(path, content=recipe(scene="flag")), 422)
        assert "not drawn yet" in refused["detail"]
        assert "graings synthesize" in refused["detail"]
