"""Requests that a page of another site makes a browser send: they change nothing and read nothing."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.settings import Settings
from tests.service.test_jobs import problem


@pytest.mark.parametrize("origin", ["http://elsewhere.example", "http://testserver:8001", "null", "nonsense"])
def test_a_page_of_another_site_cannot_start_or_delete_jobs(
    client: TestClient, archive: bytes, job: str, origin: str
) -> None:
    headers = {"Origin": origin, "Content-Type": "text/plain"}
    detail = problem(client.post("/jobs", content=archive, headers=headers), 403)["detail"]
    assert "Host" in detail
    assert client.delete(f"/jobs/{job}", headers=headers).status_code == 403
    assert [entry["id"] for entry in client.get("/jobs", headers=headers).json()["jobs"]] == [job]


@pytest.mark.parametrize("headers", [{}, {"Origin": "http://testserver"}, {"Origin": "HTTP://TestServer"}])
def test_a_page_of_the_service_and_a_script_can_start_jobs(
    client: TestClient, archive: bytes, headers: dict[str, str]
) -> None:
    assert client.post("/jobs", content=archive, headers=headers).status_code == 202


@pytest.mark.parametrize(
    "host", ["elsewhere.example", "elsewhere.example:8000", "127.0.0.1.elsewhere.example", "", "[1"]
)
def test_a_page_whose_site_resolves_to_this_machine_reads_nothing(client: TestClient, job: str, host: str) -> None:
    for method, path in (("GET", "/jobs"), ("GET", "/"), ("DELETE", f"/jobs/{job}")):
        answer = client.request(method, path, headers={"Host": host, "Origin": f"http://{host}"})
        assert "GRAINGS_ALLOWED_HOSTS" in problem(answer, 403)["detail"]
    assert [entry["id"] for entry in client.get("/jobs").json()["jobs"]] == [job]


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:8000", "[::1]:8000", "192.168.1.7:80", "TestServer:8000"])
def test_ip_addresses_and_allowed_hosts_are_answered(client: TestClient, host: str) -> None:
    assert client.get("/jobs", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    ("allowed_hosts", "host", "status"),
    [
        ("localhost", "localhost:8000", 200),
        ("localhost", "lab.example", 403),
        ("localhost, Lab.example", "lab.example:8000", 200),
        ("*", "elsewhere.example", 200),
    ],
)
def test_allowed_hosts_are_a_setting(settings: Settings, allowed_hosts: str, host: str, status: int) -> None:
    with TestClient(create_app(settings.model_copy(update={"allowed_hosts": allowed_hosts}))) as client:
        assert client.get("/jobs", headers={"Host": host}).status_code == status
