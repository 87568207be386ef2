"""FileNames: which file of a capture a listed name means, as the file systems of the people who wrote it match names.

Windows separators, upper and lower case, composed and decomposed Unicode letters and the suffix of a picture may
differ, as long as one file only is meant.
"""

from __future__ import annotations

import os
import posixpath
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from graings.capture.image_file import SUFFIXES, UNREADABLE_SUFFIXES
from graings.errors import CaptureError

# Folders of the same pictures scaled down, that nerfstudio and 3DGS write beside `images/`; used where it is absent.
FULL_SIZE: Final = "images/"
DOWNSCALED: Final = ("images_2/", "images_4/", "images_8/")


class FileNames:
    """The files below `root` by name; they are listed when the first name is not exact."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._exact: dict[str, list[str]] | None = None
        self._pictures: dict[str, list[str]] = {}

    def candidates(self, name: str) -> Iterator[str]:
        """Exact names that are tried before others."""
        yield name
        yield from (name + suffix for suffix in SUFFIXES)

    def similar(self, name: str, *, source: str, field: str | None) -> str | None:
        """The only file, relative to `root`, whose name is `name` but for the differences that are allowed; or None.

        Raises `CaptureError` naming `source` and `field` where several files are.
        """
        if self._exact is None:
            self._list()
        assert self._exact is not None
        key = _key(name)
        for table, wanted in (
            (self._exact, key),
            *((self._exact, key + suffix) for suffix in SUFFIXES),
            (self._pictures, _stem(key)),
            *((self._pictures, _stem(folder + key.removeprefix(FULL_SIZE))) for folder in _smaller(key)),
        ):
            found = table.get(wanted, [])
            if len(found) == 1:
                return found[0]
            if found:
                raise CaptureError(
                    f"{name!r} may be {' or '.join(sorted(found)[:3])}",
                    file=source,
                    field=field,
                    remedy="Write the name there as it is on disk, or remove the other file.",
                )
        return None

    def _list(self) -> None:
        self._exact = {}
        for folder, _, files in os.walk(self.root):
            for file in files:
                relative = (Path(folder) / file).relative_to(self.root).as_posix()
                key = _key(relative)
                self._exact.setdefault(key, []).append(relative)
                if key.endswith((*SUFFIXES, *UNREADABLE_SUFFIXES)):
                    self._pictures.setdefault(_stem(key), []).append(relative)


def _key(name: str) -> str:
    return unicodedata.normalize("NFC", posixpath.normpath(name.replace("\\", "/"))).casefold()


def _stem(key: str) -> str:
    stem, suffix = posixpath.splitext(key)
    return stem if suffix in SUFFIXES or suffix in UNREADABLE_SUFFIXES else key


def _smaller(key: str) -> tuple[str, ...]:
    return DOWNSCALED if key.startswith(FULL_SIZE) else ()
