"""TaskList: submit, inspect and remove the tasks of jobs.

As `jobs.queue`, it combines entries of the queue with files on disk and has no state of its own.
"""

from __future__ import annotations

import shutil
from contextlib import suppress

from graings.errors import CheckpointError
from jobs.engine import Engine, QueueEntry
from jobs.job import JobConflict, JobState, is_id
from jobs.store import Store
from jobs.task import Task, TaskFolder, TaskNotFound, TaskSpec

MAX_TASKS = 20  # of one job: their videos stay on disk


class TaskList:
    """Operations on tasks. All methods may block on the disk or the database; all are thread-safe."""

    def __init__(self, store: Store, engine: Engine) -> None:
        self._store = store
        self._engine = engine

    def submit(self, job_id: str, spec: TaskSpec) -> Task:
        """Queue a task of a job. Raises `JobConflict` when the job has as many tasks as it may have."""
        tasks = self._store.folder(job_id).tasks
        with self._store.changing():
            if len(self._ids(job_id)) >= MAX_TASKS:
                raise JobConflict(f"Job {job_id} has {MAX_TASKS} tasks. Delete one of /jobs/{job_id}/tasks first.")
            folder = TaskFolder.create(tasks, spec)
        try:
            self._engine.enqueue_task(_entry_id(job_id, folder.path.name), job_id, folder.path.name)
        except BaseException:
            shutil.rmtree(folder.path)
            raise
        return self.get(job_id, folder.path.name)

    def get(self, job_id: str, number: str) -> Task:
        """Raises `JobNotFound` and `TaskNotFound`."""
        if number not in self._ids(job_id):
            raise TaskNotFound(job_id, number)
        entry = _entry_id(job_id, number)
        return self._task(job_id, number, self._engine.entries([entry]).get(entry))

    def all(self, job_id: str) -> list[Task]:
        """The tasks of a job, newest first, without those that are damaged or deleted meanwhile."""
        numbers = self._ids(job_id)
        entries = self._engine.entries([_entry_id(job_id, number) for number in numbers])
        tasks: list[Task] = []
        for number in numbers:
            with suppress(TaskNotFound):
                tasks.append(self._task(job_id, number, entries.get(_entry_id(job_id, number))))
        return tasks

    def folder(self, job_id: str, number: str) -> TaskFolder:
        """The files of a task."""
        return TaskFolder(self._store.folder(job_id).tasks / number)

    def delete(self, job_id: str, number: str) -> None:
        """Stop a task if it has not ended, and remove it with its video."""
        if number not in self._ids(job_id):
            raise TaskNotFound(job_id, number)
        entry = self._engine.entries([_entry_id(job_id, number)]).get(_entry_id(job_id, number))
        if entry is not None and not entry.state.final:
            self._engine.cancel(entry.job_id)
        # Its process may still write for two seconds: renamed first, the folder gets no new files while it is removed.
        deleted = self._store.uploads / f"{number}.deleted"
        with suppress(FileNotFoundError):  # two requests at once
            self.folder(job_id, number).path.rename(deleted)
            shutil.rmtree(deleted)

    def _ids(self, job_id: str) -> list[str]:
        tasks = self._store.folder(job_id).tasks
        numbers = (path.name for path in tasks.iterdir()) if tasks.exists() else ()
        return sorted(filter(is_id, numbers), reverse=True)

    def _task(self, job_id: str, number: str, entry: QueueEntry | None) -> Task:
        folder = self.folder(job_id, number)
        try:
            record, progress = folder.record, folder.progress
        except CheckpointError as error:
            raise TaskNotFound(job_id, number) from error  # damaged, or deleted meanwhile
        if entry is None:  # the process that submitted it died before it was queued
            entry = QueueEntry(number, JobState.FAILED, None, record.created_at, "It was not queued. Ask for it again.")
        return Task(
            id=number,
            job_id=job_id,
            spec=record.spec,
            state=entry.state,
            created_at=record.created_at,
            finished_at=entry.finished_at,
            progress=progress,
            error=entry.error,
        )


def _entry_id(job_id: str, number: str) -> str:
    return f"{job_id}.{number}"
