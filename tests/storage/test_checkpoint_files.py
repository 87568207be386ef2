"""A checkpoint that replaces one of its name: whatever happens in between, one of the two is there."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from graings.errors import CheckpointError
from graings.storage.checkpoint import best_checkpoint, load_model, load_training
from tests.export.models import tiny_model
from tests.storage.checkpoints import save


@pytest.mark.parametrize("best", [True, False])
def test_an_error_between_the_two_renames_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, best: bool
) -> None:
    folder = save(tiny_model(), tmp_path, 7, best=best)
    rename = Path.rename

    def full(path: Path, target: Path) -> Path:
        if path.name.endswith(".part"):
            raise OSError(errno.ENOSPC, "No space left on device")
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", full)
        with pytest.raises(CheckpointError, match="earlier ones are kept"):
            save(tiny_model(), tmp_path, 7, best=best)
    assert load_model(folder).iteration == 7
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


@pytest.mark.parametrize("again", ["train", "save"])
def test_a_process_that_dies_between_the_two_renames_loses_nothing(tmp_path: Path, again: str) -> None:
    best, newest = save(tiny_model(), tmp_path, 7, best=True), save(tiny_model(), tmp_path, 8)
    best.rename(best.with_name(".best.old"))
    newest.rename(newest.with_name(f".{newest.name}.old"))
    assert best_checkpoint(tmp_path) is None
    if again == "train":
        assert load_training(tmp_path)[0].iteration == 8
    else:
        save(tiny_model(), tmp_path, 9)
        assert load_model(tmp_path).iteration == 9
    assert load_model(best).iteration == 7
    assert load_model(newest).iteration == 8
    assert not [path for path in best.parent.iterdir() if path.name.startswith(".")]


def test_what_was_replaced_already_is_removed(tmp_path: Path) -> None:
    newest = save(tiny_model(), tmp_path, 8)
    old = newest.with_name(f".{newest.name}.old")
    old.mkdir()
    assert load_training(tmp_path)[0].iteration == 8
    assert not old.exists()
