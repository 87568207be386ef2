"""A list of jobs reads the files of a job again only when they may have changed, and always then."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import pytest

from graings.storage.files import write_json
from graings.storage.run_folder import CHECKPOINTS, FACTS_FILE, METRICS_FILE
from jobs import known_jobs
from jobs.engine import QueueEntry
from jobs.job import Job, JobSpec, JobState
from jobs.known_jobs import KnownJobs, stamp_of
from jobs.queue import JobQueue
from jobs.store import JobFolder


@pytest.fixture
def settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs count as settled at once when they have ended, and each list looks at their files."""
    monkeypatch.setattr(known_jobs, "SETTLED_S", -60.0)
    monkeypatch.setattr(known_jobs, "RECENT_S", 0.0)


def submit(jobs: JobQueue, name: str = "job") -> str:
    unpacked = jobs.store.uploads / "u"
    unpacked.mkdir()
    (unpacked / "a").touch()
    return jobs.submit(JobSpec(name=name, capture="0" * 64, config={"iterations": 5}), unpacked).id


def ended(jobs: JobQueue) -> str:
    """A job that was trained and cancelled."""
    job_id = submit(jobs)
    folder = jobs.store.folder(job_id)
    folder.begin_attempt("worker")
    checkpoint(folder, 10)
    jobs.cancel(job_id)
    return job_id


def checkpoint(folder: JobFolder, iteration: int) -> None:
    write = folder.run / CHECKPOINTS / str(iteration)
    write.mkdir(parents=True)
    write_json(write / FACTS_FILE, {})


def listed(jobs: JobQueue) -> list[Job]:
    return jobs.page(10)[0]


@pytest.mark.usefixtures("settled")
def test_files_of_jobs_that_did_not_change_are_not_read_again(jobs: JobQueue, monkeypatch: pytest.MonkeyPatch) -> None:
    ended(jobs)
    submit(jobs, "waits")
    before = listed(jobs)
    assert [(job.state, job.checkpoint) for job in before] == [(JobState.QUEUED, None), (JobState.CANCELLED, 10)]

    def read(folder: JobFolder) -> None:
        raise AssertionError(f"{folder.path} is read")

    monkeypatch.setattr(JobFolder, "attempts", read)
    assert listed(jobs) == before


CHANGES: dict[str, tuple[Callable[[JobQueue, JobFolder], object], Callable[[Job], bool]]] = {
    "an evaluation": (lambda _, folder: write_json(folder.run / METRICS_FILE, {}), lambda job: job.has_metrics),
    "an attempt": (lambda _, folder: folder.begin_attempt("other"), lambda job: job.attempts == 2),
    "it waits again": (lambda jobs, folder: jobs.resume(folder.path.name), lambda job: job.state is JobState.QUEUED),
    "more iterations": (
        lambda _, folder: folder.write_spec(folder.spec().trained_for(12)),
        lambda job: job.spec.config["iterations"] == 12,
    ),
    "a damaged file": (lambda _, folder: (folder.path / "job.json").write_text("{"), lambda job: job.error is not None),
}


@pytest.mark.usefixtures("settled")
@pytest.mark.parametrize("change", CHANGES)
def test_what_changed_is_seen(jobs: JobQueue, change: str) -> None:
    folder = jobs.store.folder(ended(jobs))
    make, shows = CHANGES[change]
    (before,) = listed(jobs)
    assert not shows(before)
    make(jobs, folder)
    (after,) = listed(jobs)
    assert shows(after)
    assert shows(jobs.get(folder.path.name))


@pytest.mark.usefixtures("settled")
def test_a_deleted_job_is_not_listed_and_a_repaired_one_is_read(jobs: JobQueue) -> None:
    kept, gone = ended(jobs), ended(jobs)
    listed(jobs)
    jobs.delete(gone)
    file = jobs.store.folder(kept).path / "job.json"
    content = file.read_text()
    file.write_text("{")
    assert [(job.id, job.error is None) for job in listed(jobs)] == [(kept, False)]
    file.write_text(content)
    assert [(job.id, job.error) for job in listed(jobs)] == [(kept, None)]


@pytest.mark.usefixtures("settled")
def test_files_that_were_just_looked_at_are_not_looked_at_again_for_a_second(
    jobs: JobQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(known_jobs, "RECENT_S", 1.0)
    clock = 100.0
    monkeypatch.setattr(known_jobs, "monotonic", lambda: clock)
    folder = jobs.store.folder(ended(jobs))
    assert not listed(jobs)[0].has_metrics
    write_json(folder.run / METRICS_FILE, {})
    clock += 0.9
    assert not listed(jobs)[0].has_metrics
    clock += 0.2  # 1.1 s after the first look: the second list was none
    assert listed(jobs)[0].has_metrics
    (folder.run / METRICS_FILE).unlink()
    assert listed(jobs)[0].has_metrics
    assert not jobs.get(folder.path.name).has_metrics  # one job is always looked at
    assert not listed(jobs)[0].has_metrics
    jobs.resume(folder.path.name)
    assert listed(jobs)[0].state is JobState.QUEUED  # the queue too
    jobs.delete(folder.path.name)
    assert listed(jobs) == []


@pytest.mark.parametrize("settled_s", [60.0, -60.0])
def test_a_job_that_is_deleted_while_the_list_is_made_is_not_in_it(
    jobs: JobQueue, monkeypatch: pytest.MonkeyPatch, settled_s: float
) -> None:
    monkeypatch.setattr(known_jobs, "SETTLED_S", settled_s)
    monkeypatch.setattr(known_jobs, "RECENT_S", 0.0)
    kept, gone = ended(jobs), ended(jobs)
    assert [job.id for job in listed(jobs)] == [gone, kept]

    def wanted(job_id: str, spec: JobSpec) -> bool:
        """All jobs; deletes the files of one after its specification was read."""
        if job_id == gone:
            shutil.rmtree(jobs.store.folder(job_id).path)
        return True

    assert [job.id for job in jobs.page(10, wanted=wanted)[0]] == [kept]


@pytest.mark.usefixtures("settled")
def test_the_specification_of_a_job_is_looked_at_once_for_a_list(
    jobs: JobQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in "abc":
        submit(jobs, name)
    read = JobFolder.spec
    looked_at: list[str] = []

    def counting(folder: JobFolder) -> JobSpec:
        looked_at.append(folder.path.name)
        return read(folder)

    monkeypatch.setattr(JobFolder, "spec", counting)
    assert [job.spec.name for job in listed(jobs)] == ["c", "b", "a"]
    assert len(looked_at) == len(set(looked_at)) == 3


def test_what_a_trainer_may_still_write_is_read_every_time(jobs: JobQueue, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = jobs.store.folder(ended(jobs))  # a moment ago
    assert listed(jobs)[0].checkpoint == 10
    checkpoint(folder, 20)
    assert listed(jobs)[0].checkpoint == 20
    monkeypatch.setattr(known_jobs, "SETTLED_S", -60.0)
    jobs.resume(folder.path.name)  # it waits, and the trainer of before may not have ended
    assert listed(jobs)[0].checkpoint == 20
    checkpoint(folder, 30)
    assert listed(jobs)[0].checkpoint == 30
    running = QueueEntry(folder.path.name, JobState.RUNNING, "worker", None, None)
    assert stamp_of(folder, folder.spec(), running) is None
    assert stamp_of(folder, folder.spec(), None) is None


def test_only_the_jobs_that_were_asked_for_last_are_kept(jobs: JobQueue, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_jobs, "LIMIT", 2)
    known = KnownJobs()
    found = [jobs.get(submit(jobs, name)) for name in "abc"]
    stamps = []
    for job in found:
        folder = jobs.store.folder(job.id)
        entry = QueueEntry(job.id, JobState.QUEUED, None, None, None)
        stamps.append(stamp_of(folder, folder.spec(), entry))
        known.keep(job, stamps[-1])
    assert [known.get(job.id, stamp) for job, stamp in zip(found, stamps, strict=True)] == [None, *found[1:]]
