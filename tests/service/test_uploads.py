"""Files of uploads that never ended."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

import anyio
import pytest
from starlette.requests import Request
from starlette.testclient import TestClient

from jobs.leftovers import discard_leftovers
from service import uploads
from service.archives import Limits
from service.settings import Settings


def test_files_of_a_crashed_upload_are_removed_before_the_next_upload(
    client: TestClient, archive: bytes, settings: Settings
) -> None:
    """Not only at a restart of the service: they could fill the disk while it runs."""
    folder: Path = settings.data / "uploads"
    (folder / "dead.part").write_text("half an archive")
    (folder / "alive.part").write_text("half an archive")
    two_hours_ago = time.time() - 7_200
    os.utime(folder / "dead.part", (two_hours_ago, two_hours_ago))
    assert client.post("/jobs", content=archive).status_code == 202
    assert [path.name for path in folder.iterdir()] == ["alive.part"]


def test_an_archive_that_came_hours_ago_is_not_taken_for_a_crashed_upload(
    archive: bytes, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a resumable upload: its link has the time of the last byte. Another upload begins while it is hashed."""
    received = settings.data / "received.zip"
    received.write_bytes(archive)
    two_hours_ago = time.time() - 7_200
    os.utime(received, (two_hours_ago, two_hours_ago))
    folder = settings.data / "uploads"
    digest = uploads._digest

    def slow(path: Path) -> str:
        found = digest(path)
        discard_leftovers(folder)
        return found

    async def receive() -> None:
        request, limits = Request({"type": "http", "headers": []}), Limits(100, 10_000_000)
        async with uploads.receive_capture(request, folder, limits, received) as upload:
            assert upload.digest == hashlib.sha256(archive).hexdigest()
            assert any(upload.folder.rglob("*.json"))

    monkeypatch.setattr(uploads, "_digest", slow)
    anyio.run(receive)
    assert list(folder.iterdir()) == []
    assert received.read_bytes() == archive
