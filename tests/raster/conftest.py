"""Writes the evidence of a session where GRAINGS_EVIDENCE names a file."""

from __future__ import annotations

import os
from pathlib import Path

from tests.raster import evidence


def pytest_sessionfinish() -> None:
    if "GRAINGS_EVIDENCE" in os.environ:
        evidence.write(Path(os.environ["GRAINGS_EVIDENCE"]))
