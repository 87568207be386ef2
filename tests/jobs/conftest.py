"""A queue on an empty data folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from jobs.commands import default_database
from jobs.engine import Engine
from jobs.queue import JobQueue
from jobs.store import Store


@pytest.fixture
def jobs(tmp_path: Path) -> Iterator[JobQueue]:
    store = Store(tmp_path / "data")
    engine = Engine(default_database(store.root))
    yield JobQueue(store, engine)
    engine.close()
