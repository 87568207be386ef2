"""Requests that fail halfway and are repeated."""

from __future__ import annotations

import pytest

from graings.errors import ConfigError
from graings.storage.files import write_json
from graings.storage.run_folder import CHECKPOINTS, FACTS_FILE, RECORD_FILE
from jobs.engine import QueueEntry
from jobs.job import JobConflict, JobDamaged, JobError, JobSpec, JobState
from jobs.queue import JobQueue
from jobs.store import JobFolder


def write_record(folder: JobFolder, iterations: int) -> None:
    """What the queue reads of the record of a run."""
    folder.run.mkdir(exist_ok=True)
    write_json(folder.run / RECORD_FILE, {"config": {"iterations": iterations}})


@pytest.fixture
def succeeded(jobs: JobQueue, monkeypatch: pytest.MonkeyPatch) -> str:
    """A job that has trained its 2,000 iterations."""
    unpacked = jobs.store.uploads / "u"
    unpacked.mkdir()
    (unpacked / "a.json").write_text("")
    job_id = jobs.submit(JobSpec("job", "0" * 64, {"iterations": 2000}), unpacked).id
    write_record(jobs.store.folder(job_id), 2000)
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


def test_an_extension_counts_from_the_length_of_the_run_however_often_it_is_extended(
    jobs: JobQueue, succeeded: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A restart makes the last checkpoint later than that."""
    monkeypatch.setattr(jobs._engine, "rewind", lambda _: None)
    folder = jobs.store.folder(succeeded)
    for total in (3000, 4000):
        (folder.run / CHECKPOINTS / f"{total - 1000 + 500}").mkdir(parents=True)
        write_json(folder.run / CHECKPOINTS / f"{total - 1000 + 500}" / FACTS_FILE, {})
        assert jobs.extend(succeeded, 1000).spec.config == {"iterations": total}
        write_record(folder, total)  # as the trainer does when it starts


def test_an_extension_beyond_the_greatest_number_of_iterations_changes_nothing(jobs: JobQueue, succeeded: str) -> None:
    with pytest.raises(ConfigError, match=r"iterations: .*1000000"):
        jobs.extend(succeeded, 999_000)
    assert jobs.get(succeeded).spec.config == {"iterations": 2000}


@pytest.mark.parametrize("content", [None, "{", "{}", '{"config": []}'])
def test_an_extension_of_a_run_without_a_record_names_it(jobs: JobQueue, succeeded: str, content: str | None) -> None:
    file = jobs.store.folder(succeeded).run / RECORD_FILE
    file.unlink()
    if content is not None:
        file.write_text(content)
    with pytest.raises(JobDamaged, match=r"run\.json: not readable .*Delete the job"):
        jobs.extend(succeeded, 1000)
    assert jobs.get(succeeded).spec.config == {"iterations": 2000}
