from __future__ import annotations

from pathlib import Path

import pytest

from graings.capture.synthetic import write_synthetic


@pytest.fixture(scope="session")
def micro(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of six images of 16 px."""
    return write_synthetic(tmp_path_factory.mktemp("micro") / "capture", seed=1, frames=6, size=16, bodies=1)
