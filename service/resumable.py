"""ResumableUploads: archives that arrive in parts, over connections that break.

    <folder>/<id>.json    owner and size, and the capture that was made of it
    <folder>/<id>.part    the bytes received: their number is where the next part begins

Nothing else is remembered, so a restarted process, or another one with the same folder, continues at the same byte.
"""

from __future__ import annotations

import fcntl
import json
import os
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from graings.storage.files import write_json
from jobs.leftovers import discard_leftovers
from service.problems import UploadConflict, UploadNotFound

# An upload expires so many seconds after its last bytes arrived.
KEPT_S: Final = 86_400.0


@dataclass(frozen=True, slots=True)
class ResumableUpload:
    """An archive of `size` bytes; `capture` is the SHA-256 of the whole once a job was made of it."""

    path: Path  # without suffix; its name is the id
    owner: str | None
    size: int
    capture: str | None = None

    @property
    def archive(self) -> Path:
        """The bytes received; gone once a job was made of them."""
        return self.path.with_suffix(".part")

    @property
    def received(self) -> int:
        """Number of bytes. Raises `UploadNotFound` where they expired, or a job is just made of them."""
        if self.capture:
            return self.size
        try:
            return self.archive.stat().st_size
        except FileNotFoundError as error:
            raise UploadNotFound(self.path.name) from error

    @property
    def expires_at(self) -> float:
        """Unix seconds."""
        return self.path.with_suffix(".json" if self.capture else ".part").stat().st_mtime + KEPT_S

    def append(self, place: int, data: bytes) -> int:
        """Write `data` at byte `place`, the end of what is there, and return the new end. Raises `UploadConflict`.

        A request on a dead connection may still be open when its client sends the same bytes again: the file is locked
        only for a write, and whichever request comes second finds another end.
        """
        try:
            with self.archive.open("r+b") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                end = file.seek(0, os.SEEK_END)
                if place != end:
                    raise UploadConflict(f"The upload has {end} bytes: the next part begins with byte {end}.")
                file.write(data)
        except FileNotFoundError as error:
            raise UploadNotFound(self.path.name) from error
        return place + len(data)

    def whole(self) -> Path:
        """The archive. Raises `UploadConflict` while bytes are missing."""
        if self.received < self.size:
            raise UploadConflict(f"The upload has {self.received} of {self.size} bytes. Send the others first.")
        return self.archive

    def write(self, capture: str | None = None) -> None:
        """Record it; with the `capture` that a job was made of, without its bytes.

        The record stays, so that a client that heard no answer to its request for the job can send it again.
        """
        record = {"owner": self.owner, "size": self.size, "capture": capture}
        write_json(self.path.with_suffix(".json"), record)
        if capture is not None:
            self.archive.unlink(missing_ok=True)


class ResumableUploads:
    """The uploads in a folder. What has expired is removed by any of the methods."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(exist_ok=True)

    def begin(self, size: int, owner: str | None) -> ResumableUpload:
        discard_leftovers(self._folder, KEPT_S)
        upload = ResumableUpload(self._folder / uuid.uuid4().hex, owner, size)
        upload.archive.touch()
        upload.write()
        return upload

    def find(self, upload_id: str) -> ResumableUpload:
        """Raises `UploadNotFound`."""
        discard_leftovers(self._folder, KEPT_S)
        path = self._folder / upload_id
        try:
            return ResumableUpload(path, **json.loads(path.with_suffix(".json").read_text()))
        except FileNotFoundError as error:
            raise UploadNotFound(upload_id) from error

    def delete(self, upload_id: str) -> None:
        """Raises `UploadNotFound`."""
        upload = self.find(upload_id)
        upload.archive.unlink(missing_ok=True)
        upload.path.with_suffix(".json").unlink(missing_ok=True)
