"""Files of uploads that never ended."""

from __future__ import annotations

import os
import time
from pathlib import Path

from starlette.testclient import TestClient

from service.settings import Settings


def test_files_of_a_crashed_upload_are_removed_before_the_next_upload(
    client: TestClient, archive: bytes, settings: Settings
) -> None:
    """Not only at a restart of the service: they could fill the disk while it runs."""
    uploads: Path = settings.data / "uploads"
    (uploads / "dead.part").write_text("half an archive")
    (uploads / "alive.part").write_text("half an archive")
    two_hours_ago = time.time() - 7_200
    os.utime(uploads / "dead.part", (two_hours_ago, two_hours_ago))
    assert client.post("/jobs", content=archive).status_code == 202
    assert [path.name for path in uploads.iterdir()] == ["alive.part"]
