"""Context: what the routes of one API process work with. Knows nothing of routes."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Path, Request

from jobs.engine import Engine
from jobs.lease import Leases, open_leases
from jobs.queue import JobQueue
from jobs.store import Store, discard_leftovers
from service.archives import Limits
from service.scenes import RenderPool, Scenes
from service.settings import Settings

MB = 1_000_000


@dataclass(frozen=True, slots=True)
class Context:
    """Opened once per process by `open_context`."""

    settings: Settings
    store: Store
    engine: Engine
    jobs: JobQueue
    leases: Leases
    scenes: Scenes
    pool: RenderPool

    @property
    def limits(self) -> Limits:
        """What an upload may unpack to."""
        return Limits(self.settings.max_files, self.settings.max_unpacked_mb * MB)

    def free_mb(self) -> int:
        """Free space in the data folder."""
        return shutil.disk_usage(self.store.root).free // MB

    def close(self) -> None:
        self.leases.close()
        self.engine.close()


def open_context(settings: Settings) -> Context:
    """Open the store and the database and pick up what an earlier process left half done."""
    store = Store(settings.data)
    discard_leftovers(store.uploads)
    engine = Engine(settings.database_url)
    jobs = JobQueue(store, engine)
    jobs.enqueue_stored_jobs()
    return Context(
        settings=settings,
        store=store,
        engine=engine,
        jobs=jobs,
        leases=open_leases(settings.database_url, store.workers),
        scenes=Scenes(settings.models),
        pool=RenderPool(settings.render_slots, settings.render_waiting),
    )


def _of(request: Request) -> Context:
    context: Context = request.app.state.context
    return context


ContextDep = Annotated[Context, Depends(_of)]
JobId = Annotated[str, Path(description="Id of a job.", examples=["019a2b3c4d5e8f01"], max_length=64)]
