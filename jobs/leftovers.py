"""Leftovers: uploads of processes that died before their job was stored."""

from __future__ import annotations

import logging
import shutil
import time
from pathlib import Path

LOG = logging.getLogger(__name__)

# An upload without a write for so long belongs to a process that died.
LEFTOVER_S = 3_600.0


def discard_leftovers(uploads: Path, after_s: float = LEFTOVER_S) -> None:
    """Remove the uploads without a write for `after_s`, of processes that died; uploads of running ones stay.

    A file that cannot be removed is only logged, so that it does not prevent the next upload.
    """
    # The archive and the folder of one upload share a name. While unpacking, only the folder is written.
    groups: dict[str, list[Path]] = {}
    for path in uploads.iterdir():
        groups.setdefault(path.name.partition(".")[0], []).append(path)
    for paths in groups.values():
        try:
            if time.time() - max(_last_write(path) for path in paths) < after_s:
                continue
            for path in paths:
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink()
        except FileNotFoundError:
            continue  # removed by another process meanwhile
        except OSError as error:
            LOG.warning("an abandoned upload cannot be removed: %s", error)


def _last_write(path: Path) -> float:
    """Unix seconds of the last change to the file, or to anything in the folder. Raises `FileNotFoundError`."""
    return max(item.lstat().st_mtime for item in (path, *path.rglob("*")))
