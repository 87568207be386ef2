"""Progress: what a training job reports, as JSON lines in a file.

The trainer appends; anybody may read while it does. A position in the file is an event's id, so that a reader who
lost the connection goes on exactly where it was. Knows nothing of who reads.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

_TAIL_BYTES = 16_384  # many times the longest line


class ProgressWriter:
    """Appends lines to a progress file; a line torn by a crash is closed off first."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("ab", buffering=0)
        if self._file.tell() > 0:
            with path.open("rb") as old:
                old.seek(-1, os.SEEK_END)
                if old.read(1) != b"\n":
                    self._file.write(b"\n")

    def write(self, values: dict[str, Any]) -> None:
        """Append one line. Numbers that JSON does not have become null."""
        strict = {key: _finite(value) for key, value in values.items()}
        # One write call, so that a reader never sees half a line for longer than the kernel takes to copy it.
        self._file.write(json.dumps(strict, allow_nan=False, separators=(",", ":")).encode() + b"\n")

    def close(self) -> None:
        self._file.close()


def last_progress(path: Path) -> dict[str, Any] | None:
    """The newest whole line, or None."""
    lines, _ = read_progress(path, max(0, _size(path) - _TAIL_BYTES))
    return lines[-1][1] if lines else None


def read_progress(path: Path, start: int) -> tuple[list[tuple[int, dict[str, Any]]], int]:
    """Whole lines from byte `start` on, each with the position after it, and the position to go on from.

    A `start` in the middle of a line skips the rest of that line; one beyond the end counts as the end.
    """
    if not path.exists():
        return [], start
    with path.open("rb") as file:
        start = min(start, file.seek(0, os.SEEK_END))
        if start > 0:
            file.seek(start - 1)
            file.readline()  # nothing but the newline itself where `start` is the beginning of a line
            start = file.tell()
        file.seek(start)
        content = file.read()
    found: list[tuple[int, dict[str, Any]]] = []
    position = start
    for line in content.splitlines(keepends=True):
        if not line.endswith(b"\n"):
            break
        position += len(line)
        values = _parse(line)
        if values is not None:
            found.append((position, values))
    return found, position


def last_start(path: Path) -> int:
    """Where the newest whole line begins, for readers who want it and what follows."""
    lines, end = read_progress(path, max(0, _size(path) - _TAIL_BYTES))
    return lines[-2][0] if len(lines) > 1 else (0 if end <= _TAIL_BYTES else end)


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _parse(line: bytes) -> dict[str, Any] | None:
    """A line as an object; None for one that was torn by a crash."""
    try:
        values = json.loads(line)
    except ValueError:
        return None
    return values if isinstance(values, dict) else None


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
