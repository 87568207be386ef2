"""Who may do what: every route, for every kind of caller, on a service that only this machine reaches and on others."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import pytest
from fastapi.routing import APIRoute
from starlette.testclient import TestClient
from typer import Typer
from typer.testing import CliRunner

from jobs.job import JobSpec
from service.app import create_app
from service.commands import serve
from service.key_commands import app as key_commands
from service.keys import Keys, Scope
from service.security_headers import HEADERS
from service.settings import Settings
from tests.service.test_jobs import problem

# Without any key: the page signs in, and probes of an operator have none.
OPEN = {"get_health", "get_readiness", "get_session", "begin_session", "end_session"}
LOOKS = {"get_job", "list_jobs", "get_events", "render", "get_scene", "get_views"}  # all that a link allows
CALLERS = ("no key", "view", "read", "train", "admin", "other", "wrong")


@pytest.fixture
def closed(settings: Settings) -> Iterator[TestClient]:
    """A service that other machines can reach."""
    reachable = settings.model_copy(update={"host": "0.0.0.0"})
    with TestClient(create_app(reachable), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture
def keys(settings: Settings) -> Keys:
    return Keys(settings.data / "keys")


def bearer(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


def add_job(client: TestClient, capture: Path, owner: str | None, name: str = "scene", cancelled: bool = False) -> str:
    """A job of a key, which an upload would have made."""
    store = client.app.state.context.store  # type: ignore[attr-defined]
    folder = store.uploads / name
    folder.mkdir()
    (folder / "file").write_text(name)
    job_id: str = store.create(JobSpec(name, name, {}, owner=owner), folder)
    jobs = client.app.state.context.jobs  # type: ignore[attr-defined]
    jobs.enqueue_stored_jobs()
    if cancelled:
        jobs.cancel(job_id)
    return job_id


def operations(client: TestClient) -> list[tuple[str, str, str]]:
    """Name, method and path of every operation that is described."""
    document = client.get("/openapi.json").json()
    return [
        (operation["operationId"], method.upper(), path)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]


def allowed(client: TestClient, method: str, path: str, job: str, headers: dict[str, str]) -> str:
    """Whether a request passes the check of its caller, with the status that refuses it."""
    address = re.sub(r"\{(?!job_id)\w+\}", "x", path).replace("{job_id}", job)
    query = {"job": job} if path == "/render" else {}
    # The body is no capture and the parameter unknown: a request that passes changes nothing.
    client.cookies.clear()  # what begin_session has set
    answer = client.request(method, address, params=query, headers=headers)
    if answer.status_code in (401, 403, 429):
        assert answer.headers["www-authenticate"].startswith('Bearer realm="graings"')
        problem(answer, answer.status_code)
        return str(answer.status_code)
    if answer.status_code == 404 and "There is no job" in answer.json()["detail"] and job in answer.json()["detail"]:
        return "404"
    return "passes"


def table(client: TestClient, keys: Keys, capture: Path) -> dict[str, dict[str, str]]:
    """What happens to each operation by caller: a refusing status, or that it passes.

    The job of every request belongs to `train`, for which `read` was made.
    """
    owner, train = keys.create("train", Scope.TRAIN)
    _, read = keys.create("read", Scope.READ, parent=owner.id)
    secrets = {"train": train, "read": read, "wrong": train[:-4] + "AAAA"}
    secrets |= {"admin": keys.create("a", Scope.ADMIN)[1], "other": keys.create("other", Scope.TRAIN)[1]}
    rows: dict[str, dict[str, str]] = {}
    for name, method, path in operations(client):
        rows[name] = {}
        for caller in CALLERS:
            job = add_job(client, capture, owner.id, f"{name}-{caller}", cancelled=True)
            secrets["view"] = keys.create("link", Scope.VIEW, "link", parent=owner.id, job=job)[1]
            headers = {} if caller == "no key" else bearer(secrets[caller])
            rows[name][caller] = allowed(client, method, path, job, headers)
    return rows


def expected(name: str, method: str, path: str) -> dict[str, str]:
    if name in OPEN:
        if name == "end_session":
            return dict.fromkeys(CALLERS, "401")  # no caller has a session
        refused = "401" if name.endswith("session") else "passes"
        return {caller: refused if caller in ("no key", "wrong") else "passes" for caller in CALLERS}
    if name == "get_service_metrics":  # they count the jobs of all keys
        return {**dict.fromkeys(CALLERS, "403"), "no key": "401", "wrong": "401", "admin": "passes"}
    read_only = "passes" if method in ("GET", "HEAD") else "403"
    other = "404" if "{job_id}" in path or path == "/render" else "passes"
    refused = {"no key": "401", "view": "passes" if name in LOOKS else "403", "read": read_only}
    return {**refused, "train": "passes", "admin": "passes", "other": other, "wrong": "401"}


def test_every_operation_asks_for_the_key_it_needs(closed: TestClient, keys: Keys, capture: Path) -> None:
    assert {name for name, _, _ in operations(closed)} >= LOOKS | OPEN
    wanted = {name: expected(name, method, path) for name, method, path in operations(closed)}
    assert table(closed, keys, capture) == wanted


def test_on_its_own_machine_everybody_may_do_everything_until_there_is_a_key(
    client: TestClient, keys: Keys, capture: Path
) -> None:
    for name, method, path in operations(client):
        if name not in ("begin_session", "end_session"):
            assert allowed(client, method, path, add_job(client, capture, None, name, True), {}) == "passes", name
    wanted = {name: expected(name, method, path) for name, method, path in operations(client)}
    assert table(client, keys, capture) == wanted
    for key in keys.all():
        keys.revoke(key)
    assert client.get("/jobs").status_code == 401  # revoking the last key does not open the service again


def test_every_route_is_behind_the_check_or_named_as_open(client: TestClient) -> None:
    document = client.get("/openapi.json").json()
    unchecked = {
        operation["operationId"]
        for methods in document["paths"].values()
        for operation in methods.values()
        if operation.get("security") != [{"key": []}, {"session": []}]
    }
    assert unchecked <= OPEN
    assert set(document["components"]["securitySchemes"]) == {"key", "session"}
    hidden = {route.path for route in client.app.routes if isinstance(route, APIRoute) and not route.include_in_schema}  # type: ignore[attr-defined]
    assert hidden <= {"/", "/docs"}


def test_jobs_and_images_are_those_of_the_caller(
    closed: TestClient, keys: Keys, capture: Path, trained: Path, settings: Settings
) -> None:
    (first, first_secret), (second, second_secret) = keys.create("1", Scope.TRAIN), keys.create("2", Scope.TRAIN)
    admin = keys.create("admin", Scope.ADMIN)[1]
    jobs = {owner: add_job(closed, capture, owner, str(owner)) for owner in (first.id, second.id, None)}
    shutil.copytree(trained, settings.data / "jobs" / jobs[first.id] / "run")

    def listed(secret: str) -> set[str]:
        answer = closed.get("/jobs", headers=bearer(secret)).json()
        assert answer["next"] is None
        return {job["id"] for job in answer["jobs"]}

    assert listed(first_secret) == {jobs[first.id]}
    assert listed(second_secret) == {jobs[second.id]}
    assert listed(admin) == set(jobs.values())
    for secret, status in ((first_secret, 200), (admin, 200), (second_secret, 404)):
        assert closed.get("/render", params={"width": 8}, headers=bearer(secret)).status_code == status


@pytest.mark.parametrize(("file", "seen"), [("job.json", False), ("attempts.json", True)])
def test_a_damaged_job_is_listed_and_deleted_by_its_owner_or_where_that_is_lost_by_an_admin(
    closed: TestClient, keys: Keys, capture: Path, settings: Settings, file: str, seen: bool
) -> None:
    owner, secret = keys.create("owner", Scope.TRAIN)
    admin = keys.create("admin", Scope.ADMIN)[1]
    job = add_job(closed, capture, owner.id, cancelled=True)
    (settings.data / "jobs" / job / file).write_text("damaged")
    for headers, visible in ((bearer(secret), seen), (bearer(admin), True)):
        listed = closed.get("/jobs", headers=headers).json()["jobs"]
        assert [file in entry["error"] for entry in listed] == [True] * visible
        assert closed.get(f"/jobs/{job}", headers=headers).status_code == (200 if visible else 404)
    if not seen:
        assert closed.delete(f"/jobs/{job}", headers=bearer(secret)).status_code == 404
    assert closed.delete(f"/jobs/{job}", headers=bearer(secret if seen else admin)).status_code == 204
    assert closed.get("/jobs", headers=bearer(admin)).json()["jobs"] == []


def test_a_submitted_job_belongs_to_the_key(closed: TestClient, keys: Keys, archive: bytes) -> None:
    key, secret = keys.create("me", Scope.TRAIN)
    job = closed.post("/jobs", content=archive, headers=bearer(secret)).json()["id"]
    assert closed.app.state.context.jobs.get(job).spec.owner == key.id  # type: ignore[attr-defined]


def test_a_session_of_a_page(closed: TestClient, keys: Keys, capture: Path) -> None:
    key, secret = keys.create("me", Scope.TRAIN)
    job = add_job(closed, capture, key.id)
    answer = closed.post("/session", headers=bearer(secret))
    cookie = answer.headers["set-cookie"].lower()
    assert answer.status_code == 204
    assert all(part in cookie for part in ("httponly", "samesite=strict", "path=/", "max-age"))
    assert secret.lower() not in cookie
    assert closed.get("/session").json() == {"name": "me", "scope": "train", "job": None}
    assert [entry["id"] for entry in closed.get("/jobs").json()["jobs"]] == [job]
    # Only pages of the service change anything with it.
    assert problem(closed.post(f"/jobs/{job}/cancel"), 403)["type"].endswith("not-allowed")
    elsewhere = closed.post(f"/jobs/{job}/cancel", headers={"Origin": "http://elsewhere.example"})
    assert problem(elsewhere, 403)["type"].endswith("cross-origin")
    assert closed.post(f"/jobs/{job}/cancel", headers={"Origin": "http://testserver"}).status_code == 202
    stolen = closed.cookies["graings_session"]
    closed.delete("/session")
    assert closed.get("/jobs").status_code == 401
    assert closed.get("/jobs", headers={"Cookie": f"graings_session={stolen}"}).status_code == 401


def test_a_session_ends_with_its_key_and_with_time(
    closed: TestClient, keys: Keys, monkeypatch: pytest.MonkeyPatch
) -> None:
    key, secret = keys.create("me", Scope.TRAIN)
    closed.post("/session", headers=bearer(secret))
    assert closed.get("/jobs").status_code == 200
    keys.revoke(key)
    assert closed.get("/jobs").status_code == 401
    secret = keys.create("again", Scope.TRAIN)[1]
    closed.post("/session", headers=bearer(secret))
    monkeypatch.setattr("service.keys.SESSION_S", -1.0)
    closed.post("/session", headers=bearer(secret))
    assert closed.get("/jobs").status_code == 401
    keys.discard_expired()
    assert [key.kind for key in keys.all()] == ["key", "key", "session"]


def test_over_https_the_cookie_of_a_session_is_secure(settings: Settings, keys: Keys) -> None:
    secret = keys.create("me", Scope.TRAIN)[1]
    with TestClient(create_app(settings), base_url="https://testserver") as client:
        assert "; secure" in client.post("/session", headers=bearer(secret)).headers["set-cookie"].lower()


def test_a_link_shows_one_job_until_it_is_revoked(closed: TestClient, keys: Keys, capture: Path) -> None:
    key, secret = keys.create("me", Scope.TRAIN)
    shared, private = add_job(closed, capture, key.id, "shared"), add_job(closed, capture, key.id, "private")
    link = closed.post(f"/jobs/{shared}/links?name=aunt", headers=bearer(secret)).json()
    guest = bearer(link["address"].partition("#link=")[2])
    assert closed.get("/session", headers=guest).json() == {"name": "aunt", "scope": "view", "job": shared}
    assert [job["id"] for job in closed.get("/jobs", headers=guest).json()["jobs"]] == [shared]
    assert closed.get(f"/jobs/{private}", headers=guest).status_code == 404
    assert closed.get(f"/render?job={private}", headers=guest).status_code == 404
    assert closed.get(f"/jobs/{shared}/log", headers=guest).status_code == 403
    assert closed.post(f"/jobs/{shared}/links", headers=guest).status_code == 403
    closed.post("/session", headers=guest)
    assert closed.get(f"/jobs/{shared}").status_code == 200
    (listed,) = closed.get(f"/jobs/{shared}/links", headers=bearer(secret)).json()
    assert (listed["name"], listed["address"]) == ("aunt", None)
    assert listed["used_at"] is not None
    wrong = f"/jobs/{private}/links/{link['id']}"
    assert closed.delete(wrong, headers=bearer(secret)).status_code == 404
    assert closed.delete(f"/jobs/{shared}/links/{link['id']}", headers=bearer(secret)).status_code == 204
    assert closed.get(f"/jobs/{shared}", headers=guest).status_code == 401
    assert closed.get(f"/jobs/{shared}").status_code == 401


def test_a_key_may_send_so_many_requests_in_a_minute(settings: Settings, keys: Keys) -> None:
    few = settings.model_copy(update={"key_requests": 3})
    first, second = keys.create("1", Scope.TRAIN)[1], keys.create("2", Scope.TRAIN)[1]
    with TestClient(create_app(few)) as client:
        assert [client.get("/options", headers=bearer(first)).status_code for _ in range(4)] == [200, 200, 200, 429]
        answer = client.get("/options", headers=bearer(first))
        assert problem(answer, 429)["type"].endswith("too-many-requests")
        assert 1 <= int(answer.headers["retry-after"]) <= 60
        assert client.get("/options", headers=bearer(second)).status_code == 200


@pytest.mark.parametrize("path", ["/", "/docs", "/web/page.js", "/jobs", "/nowhere", "/healthz", "/session"])
def test_every_answer_says_what_a_browser_may_do_with_it(closed: TestClient, path: str) -> None:
    for headers in ({}, {"Host": "elsewhere.example"}):
        answer = closed.get(path, headers=headers)
        assert {name: answer.headers[name] for name in HEADERS} == HEADERS
    assert "frame-ancestors 'none'" in HEADERS["Content-Security-Policy"]


def test_keys_are_stored_as_hashes_and_listed_with_their_last_use(keys: Keys, settings: Settings) -> None:
    runner, data = CliRunner(), ["--data", str(settings.data)]
    made = runner.invoke(key_commands, ["create", "--scope", "train", "--name", "lab", *data])
    secret = made.output.strip()
    assert made.exit_code == 0
    stored = [path.read_text() for path in (settings.data / "keys").iterdir()]
    assert not any(secret[-20:] in text for text in stored)
    assert "never" in runner.invoke(key_commands, ["list", *data]).output
    key = keys.find(secret)
    assert key is not None
    listed = runner.invoke(key_commands, ["list", *data]).output
    assert "never" not in listed
    assert "lab" in listed
    assert runner.invoke(key_commands, ["revoke", "k000000000000", *data]).exit_code == 2
    assert runner.invoke(key_commands, ["revoke", key.id, *data]).exit_code == 0
    assert keys.find(secret) is None
    assert "revoked" in runner.invoke(key_commands, ["list", *data]).output


@pytest.mark.parametrize(
    "secret", ["", "x", "graings_", "graings_k00_x", "graings_k000000000000_" + "A" * 43, "\udc80"]
)
def test_what_is_no_key_is_refused(keys: Keys, secret: str) -> None:
    assert keys.find(secret) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "lab.example"])
def test_a_service_that_others_can_reach_needs_a_key_to_start(tmp_path: Path, host: str) -> None:
    app = Typer()
    app.command()(serve)
    refused = CliRunner().invoke(app, ["--host", host, "--data", str(tmp_path)])
    assert refused.exit_code == 2
    assert "graings keys create --scope admin" in refused.stderr
    assert not Settings(host=host).is_local
    assert all(Settings(host=local).is_local for local in ("127.0.0.1", "127.9.9.9", "::1", "localhost"))


@pytest.mark.parametrize("kind", ["key", "link"])
def test_signing_out_revokes_nothing_but_a_session(
    closed: TestClient, keys: Keys, capture: Path, kind: Literal["key", "link"]
) -> None:
    """Whoever was given a link must not be able to take it from the others who have it."""
    owner, _ = keys.create("me", Scope.TRAIN)
    job = add_job(closed, capture, owner.id)
    link: dict[str, Any] = {"parent": owner.id, "job": job} if kind == "link" else {}
    _, secret = keys.create("theirs", Scope.VIEW if link else Scope.TRAIN, kind, **link)
    problem(closed.delete("/session", headers={"Cookie": f"graings_session={secret}"}), 401)
    assert closed.get(f"/jobs/{job}", headers=bearer(secret)).status_code == (200 if link else 404)
    assert closed.post("/session", headers=bearer(secret)).status_code == 204
