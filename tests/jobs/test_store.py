from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from jobs.exit_code import ExitCode
from jobs.files import locked
from jobs.job import JobConflict, JobDamaged, JobNotFound, JobSpec
from jobs.store import LEFTOVER_S, Store, discard_leftovers

DIGEST = "ab" * 32


def unpacked(store: Store, name: str, *files: str) -> Path:
    folder = store.uploads / name
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(file)
    return folder


def spec(name: str = "one", capture: str = DIGEST) -> JobSpec:
    return JobSpec(name=name, capture=capture, config={"iterations": 3}, priority=7)


def test_a_job_comes_back_as_it_was_stored(tmp_path: Path) -> None:
    store = Store(tmp_path)
    job_id = store.create(spec(), unpacked(store, "u", "transforms_train.json"))
    assert store.folder(job_id).spec() == spec()
    assert store.ids() == [job_id]
    assert list(store.uploads.iterdir()) == []


def test_newer_jobs_come_first(tmp_path: Path) -> None:
    store = Store(tmp_path)
    ids = [store.create(spec(str(i)), unpacked(store, "u", "a.json")) for i in range(4)]
    assert [int(one[:11], 16) for one in store.ids()] == sorted((int(one[:11], 16) for one in ids), reverse=True)


def test_a_capture_begins_below_folders_that_hold_only_a_folder(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.create(spec(), unpacked(store, "u", "top/scene/transforms_train.json", "top/scene/train/r_0.png"))
    assert (store.capture(DIGEST) / "transforms_train.json").is_file()


def test_equal_captures_are_stored_once_and_go_with_their_last_job(tmp_path: Path) -> None:
    store = Store(tmp_path)
    first = store.create(spec(), unpacked(store, "u", "a.json"))
    second = store.create(spec(), unpacked(store, "v", "a.json"))
    assert not (store.uploads / "v").exists()
    store.delete(first)
    assert (store.capture(DIGEST) / "a.json").exists()
    store.delete(second)
    assert list((tmp_path / "captures").iterdir()) == []
    with pytest.raises(JobNotFound):
        store.folder(second)


def test_a_job_whose_trainer_still_writes_is_not_deleted(tmp_path: Path) -> None:
    store = Store(tmp_path)
    job_id = store.create(spec(), unpacked(store, "u", "a.json"))
    with locked(store.folder(job_id).lock), pytest.raises(JobConflict, match="few seconds"):
        store.delete(job_id)
    store.delete(job_id)


def test_attempts_are_counted_before_they_can_fail(tmp_path: Path) -> None:
    store = Store(tmp_path)
    folder = store.folder(store.create(spec(), unpacked(store, "u", "a.json")))
    first = folder.begin_attempt("worker-a")
    assert [(one.number, one.exit_code) for one in folder.attempts()] == [(1, None)]
    folder.end_attempt(first, ExitCode.CRASHED, "boom")
    second = folder.begin_attempt("worker-b")
    assert [(one.number, one.exit_code, one.message) for one in folder.attempts()] == [(1, 1, "boom"), (2, None, None)]
    assert second.checkpoint == 0


def test_what_is_no_job_is_none_of_the_stores(tmp_path: Path) -> None:
    store = Store(tmp_path)
    job_id = store.create(spec(), unpacked(store, "u", "a.json"))
    (tmp_path / "jobs" / ".DS_Store").write_text("")
    (tmp_path / "jobs" / "0123456789abcdef").write_text("a file with the name of a job")
    (tmp_path / "jobs" / "notes").mkdir()
    assert store.ids() == [job_id]


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"spec": 3}', '{"spec": {"name": "a"}}', None])
def test_a_job_that_cannot_be_read_says_so_and_can_be_deleted(tmp_path: Path, content: str | None) -> None:
    store = Store(tmp_path)
    damaged = store.create(spec(capture="cd" * 32), unpacked(store, "u", "a.json"))
    whole = store.create(spec(), unpacked(store, "v", "a.json"))
    record = store.folder(damaged).path / "job.json"
    record.unlink() if content is None else record.write_text(content)
    with pytest.raises(JobDamaged, match=r"job\.json.*Delete the job"):
        store.folder(damaged).spec()
    other = store.create(spec(), unpacked(store, "w", "a.json"))
    store.delete(other)  # a damaged neighbour keeps nobody from it, and what may be its capture stays
    assert len(list((tmp_path / "captures").iterdir())) == 2
    store.delete(damaged)
    assert store.ids() == [whole]
    assert [one.name for one in (tmp_path / "captures").iterdir()] == [DIGEST]


def test_damaged_attempts_name_their_file(tmp_path: Path) -> None:
    store = Store(tmp_path)
    folder = store.folder(store.create(spec(), unpacked(store, "u", "a.json")))
    (folder.path / "attempts.json").write_text('[{"no": 1}]')
    with pytest.raises(JobDamaged, match=r"attempts\.json.*Remove that file"):
        folder.attempts()


def test_a_capture_that_lost_a_file_is_replaced_by_the_same_upload(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.create(spec(), unpacked(store, "u", "a.json", "b.png"))
    (store.capture(DIGEST) / "b.png").unlink()
    store.create(spec(), unpacked(store, "v", "a.json", "b.png"))
    assert (store.capture(DIGEST) / "b.png").read_text() == "b.png"
    assert list(store.uploads.iterdir()) == []


def test_what_dead_processes_left_goes_when_nothing_was_written_for_an_hour(tmp_path: Path) -> None:
    store = Store(tmp_path)
    ages = {"old": 2 * LEFTOVER_S, "young": 0.5 * LEFTOVER_S, "unpacked": 2 * LEFTOVER_S}
    for name, age in ages.items():
        (store.uploads / f"{name}.part").write_text("")
        for one in (*unpacked(store, name, "a.json").rglob("*"), store.uploads / name, store.uploads / f"{name}.part"):
            os.utime(one, (time.time() - age,) * 2)
    os.utime(store.uploads / "unpacked" / "a.json")  # the archive is old, but somebody is still at work on it
    discard_leftovers(store.uploads)
    assert sorted(one.name for one in store.uploads.iterdir()) == ["unpacked", "unpacked.part", "young", "young.part"]
