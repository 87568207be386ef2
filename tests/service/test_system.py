from __future__ import annotations

import re
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from graings.capture.synthetic import SUITE
from graings.config import TrainConfig
from graings.errors import ConfigError
from jobs.lease import FileLeases
from jobs.store import Store
from service.app import create_app
from service.settings import Settings
from tests.service.test_jobs import problem


def test_the_options_are_those_of_training(client: TestClient) -> None:
    document = client.get("/options").json()
    assert document["schema"]["properties"].keys() == TrainConfig.model_fields.keys()
    assert document["presets"]["paper"]["iterations"] == 30_000


def test_the_options_name_the_synthetic_scenes(client: TestClient) -> None:
    scenes = client.get("/options").json()["scenes"]
    assert [(scene["name"], scene["question"]) for scene in scenes] == [(s.name, s.question) for s in SUITE]


def test_health_and_readiness(client: TestClient, job: str, settings: Settings) -> None:
    assert client.get("/healthz").json() == {"status": "ok"}
    readiness = client.get("/readyz").json()
    assert (readiness["ready"], readiness["workers"], readiness["waiting"]) == (True, 0, 1)
    leases = FileLeases(Store(settings.data).workers)
    assert leases.acquire("worker-a")
    assert client.get("/readyz").json()["workers"] == 1
    leases.close()


def test_a_full_disk_is_not_ready(settings: Settings) -> None:
    with TestClient(create_app(settings.model_copy(update={"min_free_mb": 10**9}))) as client:
        answer = client.get("/readyz")
        assert "free" in problem(answer, 503)["detail"]
        assert answer.headers["retry-after"] == "5"


def test_the_page_loads_nothing_from_other_sites(client: TestClient) -> None:
    page = client.get("/")
    assert page.headers["content-type"].startswith("text/html")
    assert "default-src 'self'" in page.headers["content-security-policy"]
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert {"/web/page.js", "/web/style.css", "/web/icon.svg"} <= set(loaded)
    for address in loaded:
        assert address.startswith("/")
        assert client.get(address).status_code == 200
    for part in ("page.js", "style.css"):
        assert "http" not in client.get(f"/web/{part}").text.replace("XMLHttpRequest", "")


def test_every_operation_is_named_and_every_error_described(client: TestClient) -> None:
    operations = [
        operation for path in client.get("/openapi.json").json()["paths"].values() for operation in path.values()
    ]
    names = [operation["operationId"] for operation in operations]
    assert len(set(names)) == len(names) >= 15
    assert all(re.fullmatch("[a-z_]+", name) for name in names)


def test_settings_come_from_the_environment_unless_given() -> None:
    settings = Settings.from_environment(
        {"GRAINGS_PORT": "81", "GRAINGS_HOST": "::1", "OTHER": "x"}, port=82, host=None
    )
    assert (settings.port, settings.host) == (82, "::1")
    assert settings.database_url.startswith("sqlite:///")
    with pytest.raises(ConfigError, match="GRAINGS_RENDER_SLOTS"):
        Settings.from_environment({"GRAINGS_RENDER_SLOTS": "none"})


def test_by_default_the_service_listens_only_on_this_machine() -> None:
    assert Settings().host == "127.0.0.1"


def test_the_documentation_lists_every_setting_with_its_default() -> None:
    text = (Path(__file__).parents[2] / "docs" / "api.md").read_text()
    for name, field in Settings.model_fields.items():
        default = "" if field.default is None else f"`{field.default}`"
        assert f"| `{name}` | {default} | {field.description} |" in text


def test_the_documentation_lists_every_route(client: TestClient) -> None:
    text = (Path(__file__).parents[2] / "docs" / "api.md").read_text()
    paths = client.get("/openapi.json").json()["paths"]
    routes = [(method.upper(), path.replace("{job_id}", "{id}")) for path in paths for method in paths[path]]
    assert len(routes) > 15
    assert [route for route in routes if f"`{route[0]} {route[1]}" not in text] == []
