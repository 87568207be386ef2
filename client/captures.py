"""Captures on their way to the service: an archive, or a folder that is packed first."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from client.answers import ClientError

CHUNK = 1 << 20

Observe = Callable[[int, int], None]


@contextmanager
def packed(capture: Path | str) -> Iterator[Path]:
    """The archive of a capture; a folder is packed into a temporary file that is removed afterwards."""
    source = Path(capture)
    if source.is_file():
        yield source
        return
    if not source.is_dir():
        raise ClientError(f"{source}: there is no such file or folder.")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "capture.zip"
        with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive:  # images are compressed already
            for path in sorted(source.rglob("*")):
                if path.is_file():
                    archive.write(path, path.relative_to(source))
        yield target


def chunks(archive: Path, observe: Observe | None, start: int = 0) -> Iterator[bytes]:
    """The content from byte `start` on. `observe` gets the number of bytes taken, and of all."""
    total = archive.stat().st_size
    with archive.open("rb") as file:
        file.seek(start)
        while chunk := file.read(CHUNK):
            yield chunk
            if observe is not None:
                observe(file.tell(), total)
