"""Engine: the durable queue. The only module that knows DBOS.

`Engine` is what everybody may ask of the queue, from any process; `executing` makes this process one that takes jobs
from it. SQLite or PostgreSQL by URL, with the same meaning. A job's state here is where it is in the queue; how far it
got is on disk.
"""

from __future__ import annotations

import logging
import re
import sqlite3
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import unquote

import psycopg  # DBOS depends on it and on SQLAlchemy, so both are always there
from dbos import DBOS, DBOSClient, DBOSConfig, DBOSPortableJSONSerializer, EnqueueOptions, WorkflowStatus
from dbos import error as dbos_error
from sqlalchemy import exc, make_url

from jobs.job import JobConflict, JobError, JobState, Outcome

LOG = logging.getLogger(__name__)

QUEUE = "train"
WORKFLOW = "train"
APPLICATION = "graings"
# Of the sequence of steps, not of the program: a job that is under way stays with workers of the same version.
# Count it up only when the steps of the workflow change.
VERSION = "jobs-1"
POLL_S = 0.5

# How long to wait for a PostgreSQL that is out of reach: five seconds for a connection, a quarter of a minute for the
# answer of another machine's kernel, half a minute for a silent connection. What the URL says itself counts more.
PATIENCE: Final = {
    "connect_timeout": "5",
    "tcp_user_timeout": "15000",
    "keepalives": "1",
    "keepalives_idle": "10",
    "keepalives_interval": "5",
    "keepalives_count": "3",
}

_SQLITE = "sqlite:///"
# What a query raises when there is no connection to be had.
_AWAY = (
    exc.OperationalError,
    exc.InterfaceError,
    exc.TimeoutError,
    psycopg.OperationalError,
    dbos_error.DBOSQueryTimeoutError,
)
_STATES = {
    "DELAYED": JobState.QUEUED,
    "ENQUEUED": JobState.QUEUED,
    "PENDING": JobState.RUNNING,
    "CANCELLED": JobState.CANCELLED,
    "ERROR": JobState.FAILED,
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": JobState.FAILED,
}


@dataclass(frozen=True, slots=True)
class QueueEntry:
    """A job's place in the queue: its state, who has it, and when (Unix seconds) and why it ended."""

    job_id: str
    state: JobState
    executor: str | None
    finished_at: float | None
    error: str | None


class Engine:
    """The queue, seen from outside. Safe to use from several threads.

    All methods raise `JobError` while the database is away.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        try:
            patient = _with_patience(url)
            _prepare(patient)
            self._client = DBOSClient(
                system_database_url=patient,
                application_name=APPLICATION,
                serializer=DBOSPortableJSONSerializer(),
                # Otherwise every caller waits until the database is back, and holds a thread of the service meanwhile.
                retry_connection_errors=False,
            )
        except Exception as error:  # whatever the database driver raises, it means one thing
            raise cannot_open(url, error) from error

    @contextmanager
    def _asking(self) -> Iterator[None]:
        """Have what the database raises when it is away mean one thing, in words without its URL."""
        try:
            yield
        except _AWAY as error:
            raise no_answer(self.url, error) from error

    def enqueue(self, job_id: str, priority: int) -> None:
        """Put a job in the queue; one that is there already stays as it is."""
        options: EnqueueOptions = {
            "workflow_name": WORKFLOW,
            "queue_name": QUEUE,
            "workflow_id": job_id,
            "priority": priority,
        }
        with self._asking():
            self._client.enqueue(options, job_id)

    def entries(self, job_ids: Sequence[str]) -> dict[str, QueueEntry]:
        """The places of these jobs; those the queue does not know are left out."""
        if not job_ids:
            return {}
        with self._asking():
            found = self._client.list_workflows(workflow_ids=list(job_ids), load_input=False)
        return {status.workflow_id: _ticket(status) for status in found}

    def running(self) -> list[QueueEntry]:
        """All jobs that a worker has taken, whether or not it still lives."""
        return [_ticket(status) for status in self._in_state("PENDING")]

    def waiting(self) -> int:
        """How many jobs wait for a worker."""
        return len(self._in_state("ENQUEUED"))

    def _in_state(self, status: str) -> list[WorkflowStatus]:
        with self._asking():
            return self._client.list_workflows(status=status, name=WORKFLOW, load_input=False, load_output=False)

    def cancel(self, job_id: str) -> None:
        """Take a job out of the queue; its worker, if any, stops within two seconds."""
        with self._asking():
            self._client.cancel_workflow(job_id)

    def requeue(self, job_ids: Sequence[str]) -> None:
        """Put jobs that were cancelled or lost their worker back in the queue.

        Raises `JobConflict`, and leaves all of them where they are, when the queue does not know one.
        """
        if not job_ids:
            return
        try:
            with self._asking():
                # Without a name they would land in DBOS's internal queue, which has no limit on concurrency.
                self._client.resume_workflows(list(job_ids), queue_name=QUEUE)
        except dbos_error.DBOSNonExistentWorkflowError as error:
            raise _unknown(job_ids) from error

    def rewind(self, job_id: str) -> None:
        """Put a job that ended back in the queue.

        Raises `JobConflict` when it has not ended, or no longer, or the queue does not know it.
        """
        try:
            with self._asking():
                self._client.rewind_workflow(job_id, queue_name=QUEUE, application_version=VERSION)
        except dbos_error.DBOSNonExistentWorkflowError as error:
            raise _unknown([job_id]) from error
        except dbos_error.DBOSException as error:  # the other things it can mean are all one: somebody else was at it
            raise JobConflict(
                f"Job {job_id} changed its state while it was put back in the queue. Look at it, and retry if it "
                "still needs that."
            ) from error

    def delete(self, job_id: str) -> None:
        """Forget a job."""
        with self._asking():
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


def _ticket(status: WorkflowStatus) -> QueueEntry:
    error: str | None = None
    if status.status == "SUCCESS":
        output = status.output or {}
        state, error = JobState(output.get("state", JobState.SUCCEEDED)), output.get("error")
    else:
        state = _STATES[status.status]
        if state is JobState.FAILED:
            error = f"The worker could not run this job: {status.error}. Its log may say more."
    finished = status.completed_at
    return QueueEntry(
        status.workflow_id, state, status.executor_id, None if finished is None else finished / 1000.0, error
    )


def _unknown(job_ids: Sequence[str]) -> JobConflict:
    return JobConflict(
        f"The queue has no entry for job {', '.join(job_ids)}: it was deleted, or its files are damaged. Mend what its "
        "error names and start the service again, which gives it an entry; or delete it and submit it anew."
    )


def _with_patience(url: str) -> str:
    if url.startswith(_SQLITE):
        return url
    parts = make_url(url)
    return parts.set(query={**PATIENCE, **parts.query}).render_as_string(hide_password=False)


def cannot_open(url: str, error: Exception) -> JobError:
    """What to say, without any secret, to whoever gave this URL of a database that does not open."""
    if _is_clear(url):
        return JobError(f"The job database{_named(url)} cannot be opened: {_why(url, error)}")
    return JobError(
        f"The job database{_named(url)} cannot be opened: its URL is wrong or ambiguous. Write it like "
        "sqlite:///path or postgresql://user:password@host/database, and write @ / ? and % in a password as %40 %2F "
        "%3F and %25"
    )


def no_answer(url: str, error: Exception) -> JobError:
    """What to say while the database is away. Why goes to the log: who asks the service need not know its inside."""
    LOG.warning("the job database%s does not answer: %s", _named(url), _why(url, error))
    return JobError("The job database does not answer at the moment. Try again in a few seconds.")


# A PostgreSQL URL that all drivers take apart alike. Of any other, one may take for a host or a port, and name in its
# message, what another takes for a part of the password.
_CODE = "%[0-9A-Fa-f]{2}"
_CLEAR = re.compile(
    r"postgres(?:ql)?(?:\+\w+)?://"
    rf"(?:(?:[^:@/?%\s]|{_CODE})*(?::(?P<password>(?:[^@/?%\s]|{_CODE})*))?@)?"  # user, password
    rf"(?:(?:[\w.-]|{_CODE})*|\[[0-9A-Fa-f:.]+\])(?::\d+)?"  # host, port
    r"(?:/[\w.-]*)?"  # database
    rf"(?:\?(?P<query>\w+=(?:[^@%\s]|{_CODE})*))?"
)


def _is_clear(url: str) -> bool:
    return url.startswith(_SQLITE) or _CLEAR.fullmatch(url) is not None


def _named(url: str) -> str:
    """The part of a URL that holds no secret, to follow a noun; nothing where that is not certain."""
    if url.startswith(_SQLITE):
        return f" {url}"
    scheme = re.match(r"[A-Za-z][A-Za-z0-9+.-]*://", url)
    return "" if scheme is None else f" {scheme[0]}…"


def _why(url: str, error: Exception) -> str:
    """The first line of a driver's message, without the secrets of the URL it speaks of."""
    if not _is_clear(url):
        return type(error).__name__
    why = (str(error).splitlines() or [repr(error)])[0]
    for secret in _secrets(url):
        why = re.sub(rf"(?<!\w){re.escape(secret)}(?!\w)", "…", why)
    return why


def _secrets(url: str) -> set[str]:
    clear = _CLEAR.fullmatch(url)
    if clear is None:
        return set()
    pairs = [pair.partition("=") for pair in (clear["query"] or "").split("&")]
    written = {clear["password"] or "", *(value for key, _, value in pairs if "pass" in key)}
    return {form for secret in written for form in (secret, unquote(secret)) if form}
