"""The address of a webhook, which may be a secret, is shown to nobody who may only look at the job."""

from __future__ import annotations

import json

import pytest
from starlette.testclient import TestClient

from jobs.job import JobSpec
from service.keys import Keys, Scope
from tests.service.test_access import bearer, closed, keys  # noqa: F401

ADDRESS = "https://hooks.example/services/secret"


@pytest.mark.parametrize("scope", ["view", "session of view", "read", "train", "admin"])
def test_only_who_may_change_a_job_sees_its_webhook(
    closed: TestClient,  # noqa: F811
    keys: Keys,  # noqa: F811
    scope: str,
) -> None:
    owner, train = keys.create("owner", Scope.TRAIN)
    context = closed.app.state.context  # type: ignore[attr-defined]
    folder = context.store.uploads / "capture"
    folder.mkdir()
    job = context.jobs.submit(JobSpec("hooked", "0" * 64, {}, owner=owner.id, webhook=ADDRESS), folder).id
    context.engine.cancel(job)  # without a message to its webhook
    secret = {
        "view": keys.create("link", Scope.VIEW, "link", parent=owner.id, job=job)[1],
        "read": keys.create("reader", Scope.READ, parent=owner.id)[1],
        "train": train,
        "admin": keys.create("admin", Scope.ADMIN)[1],
    }[scope.rpartition(" ")[2]]
    headers = bearer(secret)
    if scope.startswith("session"):
        assert closed.post("/session", headers=headers).status_code == 204
        headers = {}
    shown = ADDRESS if scope in ("train", "admin") else None
    assert closed.get(f"/jobs/{job}", headers=headers).json()["webhook"] == shown
    stream = closed.get(f"/jobs/{job}/events", headers=headers).text
    blocks = [dict(line.split(": ", 1) for line in block.splitlines()) for block in stream.strip().split("\n\n")]
    found = {block["event"]: json.loads(block["data"]) for block in blocks if "event" in block}
    assert {kind: data["webhook"] for kind, data in found.items()} == {"state": shown, "end": shown}
    texts = [stream, *(closed.get(path, headers=headers).text for path in ("/jobs", f"/jobs/{job}"))]
    assert any(ADDRESS in text for text in texts) == (shown is not None)
    assert not any("whsec_" in text for text in texts)
