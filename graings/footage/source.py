"""find_footage: the video or the photographs in a folder that holds no capture; and whether a file is a video."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from graings.footage.photos import SUFFIXES as PHOTO_SUFFIXES

VIDEO_SUFFIXES: Final = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm"})

# Fewer photographs than this are never a scene (`registration.MIN_FRAMES`).
MIN_PHOTOGRAPHS: Final = 8


def find_footage(folder: Path) -> Path | None:
    """The only video of `folder` and its folders, or the folder with all its photographs; None where there is more.

    A file of another kind, such as a transforms file or a COLMAP model, means that the folder is meant as a capture.
    Hidden files and folders do not count.
    """
    files = [path for path in folder.rglob("*") if path.is_file() and not _is_hidden(path.relative_to(folder))]
    suffixes = {path.suffix.lower() for path in files}
    if len(files) == 1 and suffixes <= VIDEO_SUFFIXES:
        return files[0]
    folders = {path.parent for path in files}
    if len(files) >= MIN_PHOTOGRAPHS and len(folders) == 1 and suffixes <= PHOTO_SUFFIXES:
        return folders.pop()
    return None


def _is_hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def video_suffix(file: Path) -> str | None:
    """The suffix for the video in `file`, by its first bytes: MP4 and QuickTime, Matroska and WebM, AVI; else None."""
    with file.open("rb") as stream:
        head = stream.read(12)
    if head[4:8] in (b"ftyp", b"moov", b"wide", b"mdat"):
        return ".mp4"
    if head.startswith(b"\x1a\x45\xdf\xa3"):
        return ".mkv"
    return ".avi" if head.startswith(b"RIFF") and head[8:] == b"AVI " else None
