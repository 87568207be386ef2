"""Files that are replaced as a whole."""

from __future__ import annotations

import json
import math
import stat
from pathlib import Path

import pytest

from graings.storage.files import sync_tree, write_bytes, write_json, write_text


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


def test_other_users_may_read_a_file(tmp_path: Path) -> None:
    write_text(tmp_path / "file", "text")
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o644


def test_a_tree_can_be_synchronised(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").write_text("text")
    sync_tree(tmp_path)
