"""What a page of another site may have a browser do: look, but change nothing."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from tests.service.test_jobs import problem


@pytest.mark.parametrize("origin", ["http://elsewhere.example", "http://testserver:8001", "null", "nonsense"])
def test_a_page_of_another_site_starts_and_deletes_nothing(
    client: TestClient, archive: bytes, job: str, origin: str
) -> None:
    headers = {"Origin": origin, "Content-Type": "text/plain"}
    detail = problem(client.post("/jobs", content=archive, headers=headers), 403)["detail"]
    assert "Host" in detail
    assert client.delete(f"/jobs/{job}", headers=headers).status_code == 403
    assert [one["id"] for one in client.get("/jobs", headers=headers).json()["jobs"]] == [job]


@pytest.mark.parametrize("headers", [{}, {"Origin": "http://testserver"}, {"Origin": "HTTP://TestServer"}])
def test_a_page_of_the_service_and_a_script_may(client: TestClient, archive: bytes, headers: dict[str, str]) -> None:
    assert client.post("/jobs", content=archive, headers=headers).status_code == 202
