"""Context: the store, queue, models and settings that the routes of one API process share."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Path, Request

from jobs.engine import Engine
from jobs.lease import Leases, open_leases
from jobs.leftovers import discard_leftovers
from jobs.queue import JobQueue
from jobs.store import Store
from jobs.task_list import TaskList
from service.archives import Limits
from service.keys import Keys
from service.pixel_limit import PixelLimit
from service.rendering import ModelCache, RenderPool
from service.request_limits import RequestLimits
from service.resumable import ResumableUploads
from service.scenes import SceneFiles
from service.settings import Settings

MB = 1_000_000


@dataclass(frozen=True, slots=True)
class Context:
    """Opened once per process by `open_context`."""

    settings: Settings
    store: Store
    engine: Engine
    jobs: JobQueue
    tasks: TaskList
    leases: Leases
    models: ModelCache
    pool: RenderPool
    scenes: SceneFiles
    keys: Keys
    resumable: ResumableUploads
    request_limits: RequestLimits
    pixel_limit: PixelLimit

    @property
    def limits(self) -> Limits:
        """Limits of an unpacked upload."""
        return Limits(self.settings.max_files, self.settings.max_unpacked_mb * MB)

    @property
    def is_open(self) -> bool:
        """Whether requests need no key: no other machine can send one, and nobody has made a key."""
        return self.settings.is_local and not self.keys.exist()

    def free_mb(self) -> int:
        """Free space in the data folder."""
        return shutil.disk_usage(self.store.root).free // MB

    def close(self) -> None:
        self.pool.close()
        self.leases.close()
        self.engine.close()


def open_context(settings: Settings) -> Context:
    """Open store and database, remove abandoned uploads, and enqueue jobs that an earlier process only stored."""
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
        tasks=TaskList(store, engine),
        leases=open_leases(settings.database_url, store.workers),
        models=ModelCache(settings.models_mb * MB),
        pool=RenderPool(settings.images_at_once, settings.images_mb * MB),
        scenes=SceneFiles(),
        keys=Keys(store.root / "keys"),
        resumable=ResumableUploads(store.root / "resumable"),
        request_limits=RequestLimits(settings.key_requests, settings.key_open_requests, settings.key_open_streams),
        pixel_limit=PixelLimit(),
    )


async def _context_of(request: Request) -> Context:
    context: Context = request.app.state.context
    return context


ContextDep = Annotated[Context, Depends(_context_of)]
JobId = Annotated[str, Path(description="Id of a job.", examples=["019a2b3c4d5e8f01"], max_length=64)]
