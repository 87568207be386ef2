"""Engine: the durable queue of jobs, and the only module that uses DBOS.

`Engine` reads and changes the queue from any process; `executing` makes this process a worker that takes jobs from it.
The database is SQLite or PostgreSQL, chosen by URL, with the same behaviour. The queue holds the state of a job; its
checkpoints and records are on disk (`jobs.store`).
"""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Awaitable, Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from typing import Any, cast

import psycopg  # DBOS depends on it and on SQLAlchemy
from dbos import DBOS, DBOSClient, DBOSConfig, DBOSPortableJSONSerializer, EnqueueOptions, WorkflowStatus
from dbos import error as dbos_error
from sqlalchemy import exc

from jobs.database_url import SQLITE_PREFIX, cannot_open, no_answer, with_connection_limits
from jobs.job import JobConflict, JobState, Outcome
from jobs.running_work import RunningWork

# Queues, whose workflows have the same names.
QUEUE = "train"
MESSAGES = "messages"  # webhooks
TASKS = "tasks"  # evaluations and videos
APPLICATION = "graings"
# Never changes: DBOS gives an interrupted job only to workers of the same version, and a worker of any version can
# continue one, because its progress is on disk.
VERSION = "jobs-1"
POLL_S = 0.5

# What a query raises when the database does not answer.
_CONNECTION_ERRORS = (
    exc.OperationalError,
    exc.InterfaceError,
    exc.TimeoutError,
    psycopg.OperationalError,
    dbos_error.DBOSQueryTimeoutError,
)
_QUEUES = (QUEUE, MESSAGES, TASKS)
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
    """A job in the queue. `executor` is the id of its worker; `finished_at` is in Unix seconds."""

    job_id: str
    state: JobState
    executor: str | None
    finished_at: float | None
    error: str | None


class Engine:
    """A client of the queue. Thread-safe. All methods raise `JobError` if the database does not answer."""

    def __init__(self, url: str) -> None:
        self.url = url
        try:
            limited = with_connection_limits(url)
            _prepare(limited)
            self._client = DBOSClient(
                system_database_url=limited,
                application_name=APPLICATION,
                serializer=DBOSPortableJSONSerializer(),
                # With retries every caller would wait until the database is back, and block a thread of the service.
                retry_connection_errors=False,
            )
        except Exception as error:  # drivers raise many classes here
            raise cannot_open(url, error) from error

    @contextmanager
    def _connection_errors(self) -> Iterator[None]:
        """Raise `JobError` without the URL in place of a driver's error."""
        try:
            yield
        except _CONNECTION_ERRORS as error:
            raise no_answer(self.url, error) from error

    def enqueue(self, job_id: str, priority: int) -> None:
        """Put a job in the queue; a job that is already there is not changed."""
        self._enqueue(QUEUE, job_id, {"priority": priority}, job_id)

    def send(self, message_id: str, job_id: str, content: dict[str, Any], attempt: int = 0, delay_s: float = 0) -> None:
        """Have a worker deliver a message to the webhook of a job; one that is already there is not sent twice."""
        delay = {"delay_seconds": delay_s} if delay_s else {}
        self._enqueue(MESSAGES, f"{message_id}.{attempt}", delay, message_id, job_id, content, attempt)

    def enqueue_task(self, task: str, job_id: str, number: str) -> None:
        """Put the task `number` of a job in the queue, as the entry `task`."""
        self._enqueue(TASKS, task, {}, job_id, number)

    def _enqueue(self, queue: str, entry: str, more: Mapping[str, Any], *arguments: Any) -> None:
        options = {**more, "workflow_name": queue, "queue_name": queue, "workflow_id": entry}
        with self._connection_errors():
            self._client.enqueue(cast(EnqueueOptions, options), *arguments)

    def entries(self, job_ids: Sequence[str]) -> dict[str, QueueEntry]:
        """The entries of these jobs by id, without those that are not in the queue."""
        if not job_ids:
            return {}
        with self._connection_errors():
            statuses = self._client.list_workflows(workflow_ids=list(job_ids), load_input=False)
        return {status.workflow_id: _entry(status) for status in statuses}

    def running(self) -> list[QueueEntry]:
        """All jobs that a worker has taken, also those of workers that died."""
        return [_entry(status) for status in self._in_state("PENDING", QUEUE)]

    def waiting(self) -> int:
        """How many jobs wait for a worker."""
        return len(self._in_state("ENQUEUED", QUEUE))

    def taken(self, executor: str | None = None) -> dict[str, str | None]:
        """What a worker has taken (None: any, also one that died): jobs, messages and tasks, with the worker's id."""
        statuses = self._in_state("PENDING", *_QUEUES)
        return {status.workflow_id: status.executor_id for status in statuses if executor in (None, status.executor_id)}

    def put_back(self, taken: Collection[str]) -> None:
        """Put back in the queue what a worker has taken."""
        for name in _QUEUES:
            ids = [status.workflow_id for status in self._in_state("PENDING", name) if status.workflow_id in taken]
            if ids:
                with self._connection_errors():
                    # Without a name they would go to DBOS's internal queue, which has no limit on concurrency.
                    self._client.resume_workflows(ids, queue_name=name)

    def _in_state(self, status: str, *names: str) -> list[WorkflowStatus]:
        with self._connection_errors():
            return self._client.list_workflows(status=status, name=list(names), load_input=False, load_output=False)

    def cancel(self, job_id: str) -> None:
        """Take a job out of the queue; its worker, if any, stops within two seconds."""
        with self._connection_errors():
            self._client.cancel_workflow(job_id)

    def requeue(self, job_ids: Sequence[str]) -> None:
        """Put jobs back in the queue that were cancelled or whose worker died.

        Raises `JobConflict`, and changes none of them, if one is not in the queue's records.
        """
        if not job_ids:
            return
        try:
            with self._connection_errors():
                self._client.resume_workflows(list(job_ids), queue_name=QUEUE)
        except dbos_error.DBOSNonExistentWorkflowError as error:
            raise _no_entry(job_ids) from error

    def rewind(self, job_id: str) -> None:
        """Put a job that ended back in the queue.

        Raises `JobConflict` if the job has not ended, if another process was first, or if the queue has no entry of it.
        """
        try:
            with self._connection_errors():
                self._client.rewind_workflow(job_id, queue_name=QUEUE, application_version=VERSION)
        except dbos_error.DBOSNonExistentWorkflowError as error:
            raise _no_entry([job_id]) from error
        except dbos_error.DBOSException as error:  # all others mean that another process changed the job meanwhile
            raise JobConflict(
                f"Job {job_id} changed its state while it was put back in the queue. Look at its state, and retry if "
                "that is still needed."
            ) from error

    def running_tasks(self, job_id: str) -> list[str]:
        """Entries of the tasks of a job that a worker has taken."""
        with self._connection_errors():
            taken = self._client.list_workflows(
                status="PENDING", name=TASKS, workflow_id_prefix=f"{job_id}.", load_input=False, load_output=False
            )
        return [status.workflow_id for status in taken]

    def delete(self, job_id: str) -> None:
        """Remove the entry of a job, its messages and its tasks."""
        with self._connection_errors():
            others = self._client.list_workflows(workflow_id_prefix=f"{job_id}.", load_input=False, load_output=False)
            self._client.delete_workflows([job_id, *(other.workflow_id for other in others)])

    def close(self) -> None:
        self._client.destroy()


@contextmanager
def executing(
    url: str,
    executor: str,
    slots: int,
    run: Callable[[str], Awaitable[Outcome]],
    deliver: Callable[[str, str, dict[str, Any], int], None],
    run_task: Callable[[str, str], Awaitable[Outcome]],
) -> Iterator[RunningWork]:
    """Take jobs from the queue while the context lasts, `slots` at a time, and await `run(job_id)` for each.

    Yields what is at work: jobs, messages and tasks.

    `deliver` sends one message (id, job, content, attempt), `run_task` does one task (job, task), one at a time. `run`
    and `run_task` are cancelled within two seconds after their work is cancelled or the context ends; they then have
    ten seconds. Enter it only once per process. `slots` is a property of the queue: the last worker to start sets it
    for all workers.
    """
    _prepare(url)
    # DBOS logs a normal cancellation as an error with a traceback. Real errors are in the job's own record and log.
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

    running_work = RunningWork()

    @DBOS.step(name="run", preemptible=True)
    async def step(job_id: str) -> dict[str, Any]:
        return asdict(await run(job_id))

    @DBOS.workflow(name=QUEUE)
    async def workflow(job_id: str) -> dict[str, Any]:
        with running_work.running(str(DBOS.workflow_id)):
            return await step(job_id)

    @DBOS.workflow(name=MESSAGES)
    def messages(message_id: str, job_id: str, content: dict[str, Any], attempt: int) -> None:
        with running_work.running(str(DBOS.workflow_id)):
            DBOS.run_step({"name": "deliver"}, deliver, message_id, job_id, content, attempt)

    @DBOS.step(name="task", preemptible=True)
    async def task_step(job_id: str, number: str) -> dict[str, Any]:
        return asdict(await run_task(job_id, number))

    @DBOS.workflow(name=TASKS)
    async def task(job_id: str, number: str) -> dict[str, Any]:
        with running_work.running(str(DBOS.workflow_id)):
            return await task_step(job_id, number)

    DBOS.listen_queues(list(_QUEUES))
    DBOS.launch()
    try:
        DBOS.register_queue(QUEUE, worker_concurrency=slots, polling_interval_sec=POLL_S, on_conflict="always_update")
        DBOS.register_queue(MESSAGES, worker_concurrency=4, polling_interval_sec=POLL_S)
        DBOS.register_queue(TASKS, worker_concurrency=1, polling_interval_sec=POLL_S)
        yield running_work
    finally:
        DBOS.destroy(destroy_registry=True)


def _prepare(url: str) -> None:
    logging.getLogger("dbos").setLevel(logging.CRITICAL)
    if url.startswith(SQLITE_PREFIX):
        # With a write-ahead log readers do not wait for writers, and recording a step takes a third of the time. The
        # setting is stored in the file.
        with closing(sqlite3.connect(url.removeprefix(SQLITE_PREFIX), timeout=30.0)) as database:
            database.execute("PRAGMA journal_mode=WAL")
    DBOS.migrate(url)


def _entry(status: WorkflowStatus) -> QueueEntry:
    error: str | None = None
    if status.status == "SUCCESS":
        output = status.output or {}
        state, error = JobState(output.get("state", JobState.SUCCEEDED)), output.get("error")
    else:
        state = _STATES[status.status]
        if state is JobState.FAILED:
            error = f"The worker could not run this job: {status.error}. Its log may have the cause."
    finished = status.completed_at
    return QueueEntry(
        status.workflow_id, state, status.executor_id, None if finished is None else finished / 1000.0, error
    )


def _no_entry(job_ids: Sequence[str]) -> JobConflict:
    return JobConflict(
        f"The queue has no entry for job {', '.join(job_ids)}: it was deleted, or its files are damaged. Repair the "
        "file that its error names and restart the service, which adds an entry; or delete it and submit the job again."
    )
