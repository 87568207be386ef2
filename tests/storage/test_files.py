"""Files that are replaced as a whole."""

from __future__ import annotations

import errno
import json
import math
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from graings.errors import OutputError
from graings.storage.files import check_writable, sync_tree, write_bytes, write_json, write_text


def test_a_file_is_replaced_and_nothing_else_is_left(tmp_path: Path) -> None:
    write_bytes(tmp_path / "file", b"one")
    write_text(tmp_path / "file", "zwei \u00fc")
    assert (tmp_path / "file").read_text(encoding="utf-8") == "zwei \u00fc"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_failed_write_leaves_no_temporary_file(tmp_path: Path) -> None:
    (tmp_path / "occupied").mkdir()
    with pytest.raises(OSError, match="occupied"):
        write_text(tmp_path / "occupied", "text")
    assert [path.name for path in tmp_path.iterdir()] == ["occupied"]


def test_a_number_that_json_does_not_have_leaves_the_old_file(tmp_path: Path) -> None:
    write_json(tmp_path / "file", {"value": 1.0})
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "file", {"value": math.nan})
    assert json.loads((tmp_path / "file").read_text()) == {"value": 1.0}
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_a_file_has_the_permissions_that_the_umask_leaves(tmp_path: Path, mask: int) -> None:
    before = os.umask(mask)
    try:
        write_text(tmp_path / "file", "text")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o666 & ~mask


@pytest.mark.parametrize("there", ["a file", "nothing yet"])
def test_a_link_stays_one_and_its_target_is_written(tmp_path: Path, there: str) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "here").mkdir()
    target, link = tmp_path / "disk/file", tmp_path / "here/link"
    if there == "a file":
        target.write_text("old")
    link.symlink_to("../disk/file")
    check_writable(link)
    write_text(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert [path.name for folder in ("disk", "here") for path in (tmp_path / folder).iterdir()] == ["file", "link"]


def test_a_link_into_no_folder_and_a_device_are_refused(tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to("absent/file")
    with pytest.raises(OutputError, match=r"link: there is no folder .*absent"):
        check_writable(link)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="pipe: is no ordinary file"):
        check_writable(tmp_path / "pipe")


def failing(code: int) -> Callable[..., None]:
    def fail(*_: object, **__: object) -> None:
        raise OSError(code, os.strerror(code))

    return fail


@pytest.mark.parametrize("call", ["open", "fsync", "replace"])
def test_an_error_names_the_file_that_was_to_be_written(
    tmp_path: Path, call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("old")
    with monkeypatch.context() as patched:
        patched.setattr(os, call, failing(errno.ENOSPC))
        with pytest.raises(OSError, match="No space left") as caught:
            write_json(tmp_path / "file", {})
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(tmp_path / "file"))
    assert caught.value.filename2 is None
    assert (tmp_path / "file").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_an_error_of_a_folder_that_is_missing_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as caught:
        write_bytes(tmp_path / "absent/file", b"")
    assert caught.value.filename == str(tmp_path / "absent/file")


def test_an_error_while_a_tree_is_synchronised_names_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("text")
    monkeypatch.setattr(os, "fsync", failing(errno.EIO))
    with pytest.raises(OSError, match="file") as caught:
        sync_tree(tmp_path)
    assert caught.value.filename == str(tmp_path / "file")


def test_a_tree_can_be_synchronised(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").write_text("text")
    sync_tree(tmp_path)
