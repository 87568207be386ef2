from __future__ import annotations

from pathlib import Path

import pytest

from graings.capture.synthetic import write_synthetic


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic(tmp_path_factory.mktemp("capture") / "tiny", seed=1, frames=12, size=16, bodies=1)
