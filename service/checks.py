"""What `graings doctor` looks at for the service: its database and its port."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

from jobs.engine import Engine
from jobs.job import JobError
from service.settings import Settings


def checks(data: Path) -> Iterator[tuple[str, str, str]]:
    """Name, verdict (ok, missing, broken) and explanation of each check, with the settings of the environment."""
    settings = Settings.from_environment(data=data)
    try:
        data.mkdir(parents=True, exist_ok=True)
        engine = Engine(settings.database_url)
        yield "database", "ok", f"answers; {engine.waiting()} jobs wait, {len(engine.running())} run"
        engine.close()
    except (JobError, OSError) as error:
        yield "database", "broken", str(error)
    with socket.socket() as probe:
        used = probe.connect_ex(("127.0.0.1", settings.port)) == 0
    yield "port", "missing" if used else "ok", f"{settings.port} is " + ("in use by some service" if used else "free")
