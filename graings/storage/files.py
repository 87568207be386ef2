"""Files that are replaced as a whole: a reader sees the old content or the new one, also after a power failure."""

from __future__ import annotations

import json
import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from graings.document import Document
from graings.errors import OutputError


def check_writable(path: Path) -> None:
    """Raises `OutputError` where `path` is no place for a file, or is in no folder that can be written to."""
    target = _behind_links(path)
    if target.is_dir():
        raise OutputError(f"{path}: is a folder where a file is wanted. Name a file in it.")
    if target.exists() and not target.is_file():
        raise OutputError(f"{path}: is no ordinary file, so it cannot be replaced. Name another place.")
    if not target.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {target.parent}. Make it, or name another place.")
    try:
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}). Name another place.") from error


def write_bytes(path: Path, content: bytes) -> None:
    """Replace a file: written beside it, synchronised, renamed. A failed write leaves the old file and nothing else.

    Of a symbolic link the file that it names is replaced. Raises `OSError` naming `path`.
    """
    target = _behind_links(path)
    part = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
    with _named(path):
        # 0o666 without the bits of the umask, as every program makes files.
        handle = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, target)
        except BaseException:
            os.unlink(part)
            raise
    sync(target.parent)


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
    with _named(path):
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


def _behind_links(path: Path) -> Path:
    """The file that `path` names, which need not exist."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors of the system name `path`: by itself it names a temporary file or, where the disk is full, none."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
