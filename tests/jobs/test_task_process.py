from __future__ import annotations

import threading
from pathlib import Path

import pytest

from graings.errors import CheckpointError
from graings.storage.locks import locked
from jobs import task_process
from jobs.job import JobSpec
from jobs.store import JobFolder, Store
from jobs.task import EvaluationSpec


def job(store: Store, monkeypatch: pytest.MonkeyPatch, evaluated: list[Path]) -> JobFolder:
    upload = store.uploads / "u"
    upload.mkdir()
    (upload / "a.json").write_text("")
    monkeypatch.setattr(task_process, "evaluate_run", lambda run, split, capture: evaluated.append(run))
    return store.folder(store.create(JobSpec("job", "0" * 64, {}), upload))


def test_an_evaluation_does_not_wait_for_a_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    evaluated: list[Path] = []
    folder = job(Store(tmp_path), monkeypatch, evaluated)
    monkeypatch.setattr(task_process, "LOCK_WAIT_S", 0.3)
    with locked(folder.lock), pytest.raises(CheckpointError, match=r"is being trained\. Evaluate it when it has ended"):
        task_process._evaluate(folder, EvaluationSpec())
    assert evaluated == []


def test_an_evaluation_waits_for_another_however_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = job(Store(tmp_path), monkeypatch, [])
    monkeypatch.setattr(task_process, "LOCK_WAIT_S", 0.3)
    running, ended = threading.Event(), threading.Event()
    evaluated: list[str] = []

    def evaluate(run: Path, split: str, capture: Path) -> None:
        running.set()
        assert ended.wait(60) or split == "test"
        evaluated.append(split)

    monkeypatch.setattr(task_process, "evaluate_run", evaluate)
    threads = [threading.Thread(target=task_process._evaluate, args=(folder, EvaluationSpec(split="val")))]
    threads[0].start()
    assert running.wait(60)
    threads.append(threading.Thread(target=task_process._evaluate, args=(folder, EvaluationSpec(split="test"))))
    threads[1].start()
    threads[1].join(1.0)
    assert evaluated == []
    ended.set()
    for thread in threads:
        thread.join(60)
    assert evaluated == ["val", "test"]


def test_an_evaluation_waits_for_a_trainer_that_is_about_to_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluated: list[Path] = []
    folder = job(Store(tmp_path), monkeypatch, evaluated)
    evaluation = threading.Thread(target=task_process._evaluate, args=(folder, EvaluationSpec()))
    with locked(folder.lock):
        evaluation.start()
        evaluation.join(0.3)
        assert evaluated == []
    evaluation.join(task_process.LOCK_WAIT_S)
    assert evaluated == [folder.run]
