"""Keys that only look: each sees the jobs of the key that it was made for."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner, Result

from service.key_commands import app as key_commands
from service.keys import Key, Keys, Scope
from service.settings import Settings
from tests.service.test_access import add_job, bearer, closed, keys  # noqa: F401


def run(settings: Settings, *words: str) -> Result:
    return CliRunner().invoke(key_commands, [*words, "--data", str(settings.data)])


def made(settings: Settings, keys: Keys, *words: str) -> tuple[Key, str]:  # noqa: F811
    """A key that the command makes, and its secret."""
    result = run(settings, "create", "--name", "made", *words)
    assert result.exit_code == 0, result.output
    secret = result.output.strip()
    key = keys.find(secret)
    assert key is not None
    return key, secret


def listed(settings: Settings) -> dict[str, list[str]]:
    """The words of `keys list` by the id that a line begins with."""
    lines = [line.split() for line in run(settings, "list").output.splitlines()]
    return {words[0]: words for words in lines if words}


@pytest.mark.parametrize("scope", ["train", "admin"])
def test_a_key_of_scope_read_sees_the_jobs_of_the_key_it_was_made_for(
    closed: TestClient,  # noqa: F811
    keys: Keys,  # noqa: F811
    settings: Settings,
    capture: Path,
    trained: Path,
    scope: str,
) -> None:
    owner, _ = made(settings, keys, "--scope", scope)
    other, _ = made(settings, keys, "--scope", "train")
    reader, secret = made(settings, keys, "--scope", "read", "--of", owner.id)
    job, foreign = add_job(closed, capture, owner.id, "mine"), add_job(closed, capture, other.id, "foreign")
    add_job(closed, capture, None, "nobody's")
    shutil.copytree(trained, settings.data / "jobs" / job / "run")
    look = bearer(secret)
    assert [entry["id"] for entry in closed.get("/jobs", headers=look).json()["jobs"]] == [job]
    for path in (f"/jobs/{job}", f"/jobs/{job}/log", f"/render?job={job}&width=8", "/render?width=8"):
        assert closed.get(path, headers=look).status_code == 200, path
    for path in (f"/jobs/{foreign}", f"/render?job={foreign}"):
        assert closed.get(path, headers=look).status_code == 404
    for path in ("/jobs?scene=walker", f"/jobs/{job}/cancel", f"/jobs/{job}/links", "/uploads?bytes=9"):
        assert closed.post(path, headers=look).status_code == 403
    assert closed.delete(f"/jobs/{job}", headers=look).status_code == 403
    closed.post("/session", headers=look)
    assert [entry["id"] for entry in closed.get("/jobs").json()["jobs"]] == [job]
    line = listed(settings)[reader.id]
    assert owner.id in line
    assert "valid" in line


def test_it_ends_with_the_key_it_was_made_for(
    closed: TestClient,  # noqa: F811
    keys: Keys,  # noqa: F811
    settings: Settings,
) -> None:
    owner, _ = made(settings, keys, "--scope", "train")
    reader, secret = made(settings, keys, "--scope", "read", "--of", owner.id)
    assert closed.get("/jobs", headers=bearer(secret)).status_code == 200
    assert run(settings, "revoke", owner.id).exit_code == 0
    assert closed.get("/jobs", headers=bearer(secret)).status_code == 401
    assert ["revoked" in listed(settings)[key.id] for key in (owner, reader)] == [True, True]


def test_a_key_that_could_never_see_a_job_is_not_made(keys: Keys, settings: Settings) -> None:  # noqa: F811
    owner, _ = made(settings, keys, "--scope", "train")
    reader, _ = made(settings, keys, "--scope", "read", "--of", owner.id)
    revoked, _ = made(settings, keys, "--scope", "train")
    keys.revoke(revoked)
    link, _ = keys.create("link", Scope.VIEW, "link", parent=owner.id, job="0" * 16)
    before = len(keys.all())
    for words, remedy in (
        (["read"], "--of"),
        (["read", "--of", "k000000000000"], "keys list"),
        (["read", "--of", "nonsense"], "keys list"),
        (["read", "--of", reader.id], "keys list"),
        (["read", "--of", revoked.id], "keys list"),
        (["read", "--of", link.id], "keys list"),
        (["train", "--of", owner.id], "--scope read"),
        (["admin", "--of", owner.id], "--scope read"),
    ):
        refused = run(settings, "create", "--name", "x", "--scope", *words)
        assert refused.exit_code == 2, words
        assert remedy in refused.stderr, words
    assert len(keys.all()) == before
