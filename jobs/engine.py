"""Engine: the durable queue. The only module that knows DBOS.

`Engine` is what everybody may ask of the queue, from any process; `executing` makes this process one that takes jobs
from it. SQLite or PostgreSQL by URL, with the same meaning. A job's state here is where it is in the queue; how far it
got is on disk.
"""

from __future__ import annotations

import functools
import logging
import re
import sqlite3
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any, Concatenate, ParamSpec, TypeVar

from dbos import DBOS, DBOSClient, DBOSConfig, DBOSPortableJSONSerializer, WorkflowStatus
from dbos import error as dbos_error
from sqlalchemy import exc  # DBOS depends on it, so it is always there

from jobs.job import JobConflict, JobError, JobState, Outcome

QUEUE = "train"
WORKFLOW = "train"
APPLICATION = "graings"
# Of the sequence of steps, not of the program: a job that is under way stays with workers of the same version.
# Count it up only when the steps of the workflow change.
VERSION = "jobs-1"
POLL_S = 0.5

_SQLITE = "sqlite:///"
_STATES = {
    "DELAYED": JobState.QUEUED,
    "ENQUEUED": JobState.QUEUED,
    "PENDING": JobState.RUNNING,
    "CANCELLED": JobState.CANCELLED,
    "ERROR": JobState.FAILED,
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": JobState.FAILED,
}


@dataclass(frozen=True, slots=True)
class Ticket:
    """A job's place in the queue: its state, who has it, and when (Unix seconds) and why it ended."""

    job_id: str
    state: JobState
    executor: str | None
    finished_at: float | None
    error: str | None


P = ParamSpec("P")
T = TypeVar("T")


def _asking(
    method: Callable[Concatenate[Engine, P], T],
) -> Callable[Concatenate[Engine, P], T]:
    """`method`, with one `JobError` for whatever shows that the database is away."""

    @functools.wraps(method)
    def asked(self: Engine, /, *args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return method(self, *args, **kwargs)
        except (exc.OperationalError, exc.InterfaceError, exc.TimeoutError) as error:
            raise JobError(f"The job database does not answer: {_reason(error, self.url)}. Try again later.") from error

    return asked


class Engine:
    """The queue, seen from outside. Safe to use from several threads.

    Every method raises `JobError` while the database is away.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        try:
            _prepare(url)
            self._client = DBOSClient(
                system_database_url=url,
                application_name=APPLICATION,
                serializer=DBOSPortableJSONSerializer(),
                # Who asks would else wait in its thread for as long as the database is away, in the end all threads.
                retry_connection_errors=False,
            )
        except Exception as error:  # whatever the database driver raises, it means one thing
            # Of other addresses no more than their kind: a password may be anywhere in them.
            named = url if url.startswith(_SQLITE) else f"({re.split('[:/]', url)[0]})"
            raise JobError(f"The job database {named} cannot be opened: {_reason(error, url)}") from error

    @_asking
    def enqueue(self, job_id: str, priority: int) -> None:
        """Put a job in the queue; one that is there already stays as it is."""
        self._client.enqueue(
            {"workflow_name": WORKFLOW, "queue_name": QUEUE, "workflow_id": job_id, "priority": priority}, job_id
        )

    @_asking
    def tickets(self, job_ids: Sequence[str]) -> dict[str, Ticket]:
        """The places of these jobs; those the queue does not know are left out."""
        if not job_ids:
            return {}
        found = self._client.list_workflows(workflow_ids=list(job_ids), load_input=False)
        return {status.workflow_id: _ticket(status) for status in found}

    @_asking
    def running(self) -> list[Ticket]:
        """All jobs that a worker has taken, whether or not it still lives."""
        found = self._client.list_workflows(status="PENDING", name=WORKFLOW, load_input=False, load_output=False)
        return [_ticket(status) for status in found]

    @_asking
    def waiting(self) -> int:
        """How many jobs wait for a worker."""
        return len(self._client.list_workflows(status="ENQUEUED", name=WORKFLOW, load_input=False, load_output=False))

    @_asking
    def cancel(self, job_id: str) -> None:
        """Take a job out of the queue; its worker, if any, stops within two seconds."""
        self._client.cancel_workflow(job_id)

    @_asking
    def requeue(self, job_ids: Sequence[str]) -> None:
        """Put jobs that were cancelled or lost their worker back in the queue."""
        if job_ids:
            # Without a name they would land in DBOS's internal queue, which has no limit on concurrency.
            self._client.resume_workflows(list(job_ids), queue_name=QUEUE)

    @_asking
    def rewind(self, job_id: str) -> None:
        """Put a job that ended back in the queue. Raises `JobConflict` when it is not there or no longer ended."""
        try:
            self._client.rewind_workflow(job_id, queue_name=QUEUE, application_version=VERSION)
        except dbos_error.DBOSException as error:
            raise JobConflict(
                f"Job {job_id} cannot be tried again: the queue has lost it, or it was queued again meanwhile. "
                "Look at it again, or delete it and submit a new one."
            ) from error

    @_asking
    def delete(self, job_id: str) -> None:
        """Forget a job."""
        self._client.delete_workflow(job_id)

    def close(self) -> None:
        self._client.destroy()


@contextmanager
def executing(url: str, executor: str, slots: int, run: Callable[[str], Awaitable[Outcome]]) -> Iterator[None]:
    """Take jobs from the queue while the context lasts, `slots` at a time, and await `run(job_id)` for each.

    `run` is cancelled within two seconds when its job is, and when the context ends; it then has ten seconds. Once per
    process. `slots` is a property of the queue: the value of the worker that started last counts for all.
    """
    _prepare(url)
    # DBOS reports a normal cancellation as a traceback; what matters reaches the job's own record and log.
    config = DBOSConfig(
        name=APPLICATION,
        system_database_url=url,
        application_version=VERSION,
        executor_id=executor,
        serializer=DBOSPortableJSONSerializer(),
        log_level="CRITICAL",
        enable_otlp=False,
    )
    DBOS(config=config)

    @DBOS.step(name="run", preemptible=True)
    async def step(job_id: str) -> dict[str, Any]:
        outcome = await run(job_id)
        return {"state": outcome.state.value, "error": outcome.error}

    @DBOS.workflow(name=WORKFLOW)
    async def workflow(job_id: str) -> dict[str, Any]:
        return await step(job_id)

    DBOS.listen_queues([QUEUE])
    DBOS.launch()
    try:
        DBOS.register_queue(QUEUE, worker_concurrency=slots, polling_interval_sec=POLL_S, on_conflict="always_update")
        yield
    finally:
        DBOS.destroy(destroy_registry=True)


def _prepare(url: str) -> None:
    logging.getLogger("dbos").setLevel(logging.CRITICAL)
    if url.startswith(_SQLITE):
        # Readers do not wait for writers, and a recorded step costs a third. The file remembers it.
        with closing(sqlite3.connect(url.removeprefix(_SQLITE), timeout=30.0)) as database:
            database.execute("PRAGMA journal_mode=WAL")
    DBOS.migrate(url)


def _ticket(status: WorkflowStatus) -> Ticket:
    error: str | None = None
    if status.status == "SUCCESS":
        output = status.output or {}
        state, error = JobState(output.get("state", JobState.SUCCEEDED)), output.get("error")
    else:
        state = _STATES[status.status]
        if state is JobState.FAILED:
            error = f"The worker could not run this job: {status.error}. Its log may say more."
    finished = status.completed_at
    return Ticket(status.workflow_id, state, status.executor_id, None if finished is None else finished / 1000.0, error)


def _reason(error: Exception, url: str) -> str:
    """The first line of an error without what may be a password of `url`."""
    reason = (str(error).splitlines() or [repr(error)])[0]
    for secret in _secrets(url):
        reason = reason.replace(secret, "…")
    return reason


def _secrets(url: str) -> list[str]:
    """Parts of what stands between the user's name and the last @, and of a password among the parameters.

    Parts, because a driver takes a password with an @ or a / in it for a host or a path, and says so.
    """
    before, _, _ = url.rpartition("@")
    _, _, given = before.rpartition("//")[2].partition(":")
    texts = [given, *re.findall(r"[?&]password=([^&]*)", url)]
    return [part for text in texts for part in re.split("[@/:?#]", text) if part]
