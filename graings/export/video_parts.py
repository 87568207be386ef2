"""VideoParts: the frames of a video in the making, in a hidden folder beside it until the video is whole.

A part is a short video, or one picture of a folder of pictures. A call that was interrupted finds the parts that are
whole and goes on after them; one that makes another video under the same name removes them. Parts of H.264 and VP9
have the codec of the video and are joined without being encoded anew. Those of animated pictures, whose formats have
no such parts, are lossless.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from graings.errors import CheckpointError
from graings.export.video_file import decoded, join, video_file
from graings.storage.files import write_text
from graings.storage.locks import locked

FRAMES: Final = 120  # of a part
LOCK_FILE: Final = ".lock"
IDENTITY_FILE: Final = "identity.txt"

_SUFFIXES: Final = {"": ".png", ".webp": ".mkv", ".gif": ".mkv"}  # of parts, where it is not that of the video


@dataclass(frozen=True, slots=True)
class VideoParts:
    """The parts of the video `path` in `folder`, each of `frames` frames but the last."""

    path: Path
    folder: Path
    frames: int

    def file(self, first: int) -> Path:
        """The part that begins with frame `first`."""
        kind = self.path.suffix.lower()
        return self.folder / f"{first:05d}{_SUFFIXES.get(kind, kind)}"

    def finish(self, total: int, width: int, height: int, fps: float) -> None:
        """Make the video of its parts, which then are gone."""
        parts = [self.file(first) for first in range(0, total, self.frames)]
        if not self.path.suffix:
            (self.folder / IDENTITY_FILE).unlink()
            (self.folder / LOCK_FILE).unlink()
            self.folder.replace(self.path)
            return
        if parts[0].suffix == self.path.suffix.lower():
            join(parts, self.frames, self.path, fps)
        else:
            with video_file(self.path, width, height, fps) as add:
                for part in parts:
                    for levels in decoded(part):
                        add(levels)
        shutil.rmtree(self.folder)


@contextmanager
def open_parts(path: Path, identity: str) -> Iterator[VideoParts]:
    """The parts of the video `path` that are whole, if `identity`, which stands for all that decides how it looks, is
    that with which they were made.

    Raises `CheckpointError` while another process makes this video, and where `path` is a folder in place
    of a file, a file in place of a folder, or a folder that is not empty.
    """
    other_kind = path.exists() and path.is_dir() == bool(path.suffix)
    if other_kind or (path.is_dir() and any(path.iterdir())):
        raise CheckpointError(f"{path}: exists already. Choose another name, or remove it.")
    folder = path.with_name(f".{path.name}.parts")
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder / LOCK_FILE, wait=False) as free:
        if not free:
            raise CheckpointError(f"{path}: is being made by another process. Wait for it, or stop it.")
        known = folder / IDENTITY_FILE
        if not known.exists() or known.read_text() != identity:
            for file in folder.iterdir():
                if file.name != LOCK_FILE:
                    file.unlink()
            write_text(known, identity)
        parts = VideoParts(path, folder, FRAMES if path.suffix else 1)
        try:
            yield parts
        finally:
            if folder.exists() and not any(folder.glob(f"[0-9]*{parts.file(0).suffix}")):
                shutil.rmtree(folder)
