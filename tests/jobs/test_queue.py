"""Requests that fail halfway and are repeated."""

from __future__ import annotations

import pytest

from jobs.engine import QueueEntry
from jobs.job import JobConflict, JobError, JobSpec, JobState
from jobs.queue import JobQueue


@pytest.mark.parametrize("error", [JobError, JobConflict, KeyboardInterrupt])
def test_an_extension_that_failed_and_is_repeated_counts_once(
    jobs: JobQueue, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    unpacked = jobs.store.uploads / "u"
    unpacked.mkdir()
    (unpacked / "a.json").write_text("")
    job_id = jobs.submit(JobSpec("job", "0" * 64, {"iterations": 2000}), unpacked).id
    succeeded = QueueEntry(job_id, JobState.SUCCEEDED, None, 1.0, None)
    monkeypatch.setattr(jobs._engine, "entries", lambda _: {job_id: succeeded})

    def fail(_: str) -> None:
        raise error("no answer")

    monkeypatch.setattr(jobs._engine, "rewind", fail)
    with pytest.raises(error, match="no answer"):
        jobs.extend(job_id, 1000)
    assert jobs.get(job_id).spec.config == {"iterations": 2000}
    monkeypatch.setattr(jobs._engine, "rewind", lambda _: None)
    assert jobs.extend(job_id, 1000).spec.config == {"iterations": 3000}
