"""What uploads leave on the disk when they never end."""

from __future__ import annotations

import os
import time
from pathlib import Path

from starlette.testclient import TestClient

from service.settings import Settings


def test_what_a_crash_left_goes_before_the_next_upload(client: TestClient, archive: bytes, settings: Settings) -> None:
    """The service need not start again for it: without this, leftovers may fill the disk for as long as it runs."""
    uploads: Path = settings.data / "uploads"
    (uploads / "dead.part").write_text("half an archive")
    (uploads / "alive.part").write_text("half an archive")
    two_hours_ago = time.time() - 7_200
    os.utime(uploads / "dead.part", (two_hours_ago, two_hours_ago))
    assert client.post("/jobs", content=archive).status_code == 202
    assert [one.name for one in uploads.iterdir()] == ["alive.part"]
