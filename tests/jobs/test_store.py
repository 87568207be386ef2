from __future__ import annotations

import os
import shutil
import stat
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest

from graings.storage.files import sync
from graings.storage.locks import locked
from jobs.exit_code import ExitCode
from jobs.job import JobConflict, JobDamaged, JobNotFound, JobSpec
from jobs.leftovers import LEFTOVER_S, discard_leftovers
from jobs.store import Store

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


def test_a_job_on_a_video_is_trained_on_the_capture_that_was_made_of_it(tmp_path: Path) -> None:
    store = Store(tmp_path)
    job_id = store.create(spec(), unpacked(store, "u", "video.mp4"))
    assert store.trained_on(job_id) == store.capture(DIGEST)
    store.folder(job_id).capture.mkdir()
    assert store.trained_on(job_id) == store.folder(job_id).capture


@pytest.mark.parametrize("step", range(4))
def test_a_submission_with_a_key_whose_process_died_makes_one_job_when_it_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """It dies after the job's record is written, after its link, after its folder is in place, and not at all."""

    class Killed(BaseException):
        pass

    def dies(*_: object) -> None:
        raise Killed

    def dies_at(folder: Path) -> Callable[[Path], None]:
        return lambda path: dies() if path == folder else sync(path)

    store = Store(tmp_path)
    with monkeypatch.context() as patch:
        if step == 0:
            patch.setattr(Path, "symlink_to", dies)
        elif step < 3:
            patch.setattr("jobs.store.sync", dies_at(tmp_path / ("submissions" if step == 1 else "jobs")))
        with pytest.raises(Killed) if step < 3 else nullcontext():
            store.create(spec(), unpacked(store, "u", "a.json"), "key")
    jobs = {store.create(spec(), unpacked(store, name, "a.json"), "key") for name in ("v", "w")}
    assert jobs == set(store.ids())
    assert len(jobs) == 1


def test_newer_jobs_come_first(tmp_path: Path) -> None:
    store = Store(tmp_path)
    ids = [store.create(spec(str(i)), unpacked(store, "u", "a.json")) for i in range(4)]
    assert [int(job_id[:11], 16) for job_id in store.ids()] == sorted(
        (int(job_id[:11], 16) for job_id in ids), reverse=True
    )


def test_a_capture_begins_below_folders_that_hold_only_a_folder(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.create(spec(), unpacked(store, "u", "top/scene/transforms_train.json", "top/scene/train/r_0.png"))
    assert (store.capture(DIGEST) / "transforms_train.json").is_file()


def test_equal_captures_are_stored_once_and_removed_with_their_last_job(tmp_path: Path) -> None:
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


def test_a_job_is_not_deleted_while_its_trainer_runs(tmp_path: Path) -> None:
    store = Store(tmp_path)
    job_id = store.create(spec(), unpacked(store, "u", "a.json"))
    with locked(store.folder(job_id).lock), pytest.raises(JobConflict, match="few seconds"):
        store.delete(job_id)
    store.delete(job_id)


def test_attempts_are_recorded_before_they_end(tmp_path: Path) -> None:
    store = Store(tmp_path)
    folder = store.folder(store.create(spec(), unpacked(store, "u", "a.json")))
    first = folder.begin_attempt("worker-a")
    assert [(attempt.number, attempt.exit_code) for attempt in folder.attempts()] == [(1, None)]
    folder.end_attempt(first, ExitCode.CRASHED, "boom")
    second = folder.begin_attempt("worker-b")
    recorded = [(attempt.number, attempt.exit_code, attempt.message) for attempt in folder.attempts()]
    assert recorded == [(1, 1, "boom"), (2, None, None)]
    assert second.checkpoint == 0


def test_other_files_in_the_folder_of_jobs_are_ignored(tmp_path: Path) -> None:
    store = Store(tmp_path)
    job_id = store.create(spec(), unpacked(store, "u", "a.json"))
    (tmp_path / "jobs" / ".DS_Store").write_text("")
    (tmp_path / "jobs" / "0123456789abcdef").write_text("a file with the name of a job")
    (tmp_path / "jobs" / "notes").mkdir()
    assert store.ids() == [job_id]


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"spec": 3}', '{"spec": {"name": "a"}}', None])
def test_a_damaged_job_names_its_file_and_can_be_deleted(tmp_path: Path, content: str | None) -> None:
    store = Store(tmp_path)
    damaged = store.create(spec(capture="cd" * 32), unpacked(store, "u", "a.json"))
    whole = store.create(spec(), unpacked(store, "v", "a.json"))
    record = store.folder(damaged).path / "job.json"
    record.unlink() if content is None else record.write_text(content)
    with pytest.raises(JobDamaged, match=r"job\.json.*Delete the job"):
        store.folder(damaged).spec()
    other = store.create(spec(), unpacked(store, "w", "a.json"))
    store.delete(other)  # possible beside a damaged job, whose capture must stay
    assert len(list((tmp_path / "captures").iterdir())) == 2
    store.delete(damaged)
    assert store.ids() == [whole]
    assert [path.name for path in (tmp_path / "captures").iterdir()] == [DIGEST]


def test_a_run_that_is_missing_or_no_folder_has_no_files(tmp_path: Path) -> None:
    store = Store(tmp_path)
    folder = store.folder(store.create(spec(), unpacked(store, "u", "a.json")))
    assert folder.run_files() == frozenset()
    folder.run.touch()
    assert folder.run_files() == frozenset()
    folder.run.unlink()
    folder.run.mkdir()
    folder.metrics.touch()
    assert folder.run_files() == {"metrics.json"}


def test_damaged_attempts_name_their_file(tmp_path: Path) -> None:
    store = Store(tmp_path)
    folder = store.folder(store.create(spec(), unpacked(store, "u", "a.json")))
    (folder.path / "attempts.json").write_text('[{"no": 1}]')
    with pytest.raises(JobDamaged, match=r"attempts\.json.*Remove that file"):
        folder.attempts()


def test_a_capture_with_a_missing_file_is_replaced_by_the_same_upload(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.create(spec(), unpacked(store, "u", "a.json", "b.png"))
    (store.capture(DIGEST) / "b.png").unlink()
    store.create(spec(), unpacked(store, "v", "a.json", "b.png"))
    assert (store.capture(DIGEST) / "b.png").read_text() == "b.png"
    assert list(store.uploads.iterdir()) == []


def age(path: Path, seconds: float) -> None:
    """Set the last change of `path` and of everything below it to `seconds` ago."""
    then = time.time() - seconds
    for item in (path, *path.rglob("*")):
        os.utime(item, (then, then))


def test_an_upload_without_a_recent_write_is_removed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for name, seconds in (("old", LEFTOVER_S + 60), ("young", LEFTOVER_S - 60)):
        (store.uploads / f"{name}.part").write_text("")
        unpacked(store, name, "train/a.json")
        age(store.uploads / f"{name}.part", seconds)
        age(store.uploads / name, seconds)
    discard_leftovers(store.uploads)
    assert sorted(path.name for path in store.uploads.iterdir()) == ["young", "young.part"]


def test_an_upload_that_is_being_unpacked_is_kept(tmp_path: Path) -> None:
    """Its archive and its folder are old: only a file deep inside is new."""
    store = Store(tmp_path)
    (store.uploads / "u.part").write_text("")
    folder = unpacked(store, "u", "train/a.json")
    for path in (store.uploads / "u.part", folder):
        age(path, 2 * LEFTOVER_S)
    (folder / "train" / "a.json").write_text("more")
    discard_leftovers(store.uploads)
    assert sorted(path.name for path in store.uploads.iterdir()) == ["u", "u.part"]


def test_a_leftover_that_cannot_be_removed_is_logged_and_the_others_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    store = Store(tmp_path)
    for name in ("u", "v"):
        age(unpacked(store, name, "a.json"), 2 * LEFTOVER_S)
    (store.uploads / "w.part").write_text("")
    age(store.uploads / "w.part", 2 * LEFTOVER_S)

    def denied(path: Path) -> None:
        raise PermissionError(f"{path}: denied")

    monkeypatch.setattr(shutil, "rmtree", denied)
    discard_leftovers(store.uploads)
    assert sorted(path.name for path in store.uploads.iterdir()) == ["u", "v"]
    assert caplog.text.count("denied") == 2


def test_an_old_job_that_is_being_deleted_is_not_taken_for_a_leftover(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise another process that removes leftovers meanwhile would make the deletion fail."""
    store = Store(tmp_path)
    job_id = store.create(spec(), unpacked(store, "u", "a.json"))
    store.folder(job_id).lock.touch()  # as left by a trainer
    age(store.folder(job_id).path, 2 * LEFTOVER_S)
    remove = shutil.rmtree

    def slowly(path: Path, **options: bool) -> None:
        monkeypatch.setattr(shutil, "rmtree", remove)
        discard_leftovers(store.uploads)
        remove(path, **options)

    monkeypatch.setattr(shutil, "rmtree", slowly)
    store.delete(job_id)
    assert store.ids() == []
    assert list((tmp_path / "captures").iterdir()) == []


def test_a_new_job_is_synced_to_the_disk_before_its_id_is_returned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power failure discards what is not synced: the content of files, and renames whose folder is not synced."""
    store = Store(tmp_path)
    capture = unpacked(store, "u", "a.json", "images/b.png")
    written = {(path.stat().st_ino, path.stat().st_size) for path in capture.rglob("*") if path.is_file()}
    synced: list[tuple[int, list[str]]] = []
    files: set[tuple[int, int]] = set()  # synced before the capture is moved

    def fsync(handle: int) -> None:
        status = os.fstat(handle)
        if stat.S_ISDIR(status.st_mode):
            synced.append((status.st_ino, os.listdir(handle)))
        elif not any((tmp_path / "captures").iterdir()):
            files.add((status.st_ino, status.st_size))

    monkeypatch.setattr(os, "fsync", fsync)
    job_id = store.create(spec(), capture)
    assert len(written) == 2
    assert written <= files
    assert (store.capture(DIGEST).joinpath("images").stat().st_ino, ["b.png"]) in synced
    assert ((tmp_path / "captures").stat().st_ino, [DIGEST]) in synced
    assert (store.folder(job_id).path.stat().st_ino, ["job.json"]) in synced
    assert synced[-1] == ((tmp_path / "jobs").stat().st_ino, [job_id])
    store.folder(job_id).begin_attempt("worker")
    assert "attempts.json" in synced[-1][1]
