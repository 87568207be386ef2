"""Requests that fail halfway and are repeated."""

from __future__ import annotations

import pytest

from graings.storage.files import write_json
from graings.storage.run_folder import CHECKPOINTS, FACTS_FILE
from jobs.engine import QueueEntry
from jobs.job import JobConflict, JobError, JobSpec, JobState
from jobs.queue import JobQueue


@pytest.fixture
def succeeded(jobs: JobQueue, monkeypatch: pytest.MonkeyPatch) -> str:
    """A job that has trained its 2,000 iterations."""
    unpacked = jobs.store.uploads / "u"
    unpacked.mkdir()
    (unpacked / "a.json").write_text("")
    job_id = jobs.submit(JobSpec("job", "0" * 64, {"iterations": 2000}), unpacked).id
    checkpoint = jobs.store.folder(job_id).run / CHECKPOINTS / "00002000"
    checkpoint.mkdir(parents=True)
    write_json(checkpoint / FACTS_FILE, {})
    entry = QueueEntry(job_id, JobState.SUCCEEDED, None, 1.0, None)
    monkeypatch.setattr(jobs._engine, "entries", lambda _: {job_id: entry})
    return job_id


@pytest.mark.parametrize("error", [JobError, JobConflict, KeyboardInterrupt])
def test_an_extension_that_failed_and_is_repeated_counts_once(
    jobs: JobQueue, succeeded: str, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    def fail(_: str) -> None:
        raise error("no answer")

    monkeypatch.setattr(jobs._engine, "rewind", fail)
    with pytest.raises(error, match="no answer"):
        jobs.extend(succeeded, 1000)
    assert jobs.get(succeeded).spec.config == {"iterations": 2000}
    monkeypatch.setattr(jobs._engine, "rewind", lambda _: None)
    assert jobs.extend(succeeded, 1000).spec.config == {"iterations": 3000}


def test_an_extension_whose_process_died_halfway_and_is_repeated_counts_once(
    jobs: JobQueue, succeeded: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = jobs.store.folder(succeeded)
    folder.write_spec(folder.spec().trained_for(3000))  # the process died before the queue knew
    monkeypatch.setattr(jobs._engine, "rewind", lambda _: None)
    assert jobs.extend(succeeded, 1000).spec.config == {"iterations": 3000}
