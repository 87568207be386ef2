"""Files that are replaced as a whole: a reader sees the old content or the new one, also after a power failure."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from graings.document import Document
from graings.errors import OutputError


def check_writable(path: Path) -> None:
    """Raises `OutputError` where `path` is a folder, or is in none that can be written to."""
    if path.is_dir():
        raise OutputError(f"{path}: is a folder where a file is wanted. Name a file in it.")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}. Make it, or name another place.")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}). Name another place.") from error


def write_bytes(path: Path, content: bytes) -> None:
    """Replace a file: written beside it, synchronised, renamed. A failed write leaves the old file and nothing else."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)  # mkstemp gives only the owner access
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise
    sync(path.parent)


def write_text(path: Path, text: str) -> None:
    """As `write_bytes`, for text in UTF-8."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """As `write_bytes`, for a value as strict JSON. Raises `ValueError` for NaN and infinity."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_document(path: Path, document: Document) -> None:
    """As `write_json`, for a document; `graings.document.read_document` reads it back."""
    write_json(path, document.to_json())


def sync(path: Path) -> None:
    """Write a file, or the entries of a folder, to the disk: until then a power failure may undo a rename in it."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(path: Path) -> None:
    """Write the folder, the folders in it and the contents of all their files to the disk."""
    for folder, _, files in os.walk(path):
        for name in files:
            sync(Path(folder, name))
        sync(Path(folder))
