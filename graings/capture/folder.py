"""CaptureFolder: all access of the readers to files of a capture.

It refuses every path that leads outside, checks that images are complete, and records what was read, so that the
capture gets a hash that does not depend on its path.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from graings.capture.image_file import SUFFIXES, ImageFile, check_image
from graings.capture.names import FileNames
from graings.errors import CaptureError


def is_utf8(name: str) -> bool:
    """Whether a name can be encoded; bytes of another encoding come from the file system as lone surrogates."""
    return not any("\ud800" <= letter <= "\udfff" for letter in name)


class CaptureFolder:
    """A capture on disk. All names are relative to `root`, with forward slashes."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        if not is_utf8(str(self.root)):
            remedy = "Rename the folder, or the one above it that has such a name."
            raise CaptureError("its path is not UTF-8, so that images cannot be opened", file=root, remedy=remedy)
        self._digests: dict[str, str] = {}
        self._images: dict[str, ImageFile] = {}
        self._names = FileNames(self.root)
        self._respelled: dict[str, str] = {}
        self._pictures: dict[str, list[str]] = {}

    def locate(self, name: str, *, source: str, field: str | None = None) -> Path:
        """The path of `name`, whether it exists or not; `source` and `field` are where the capture names it.

        Raises `CaptureError` where the name, or a link on its way, leads outside the capture.
        """
        try:
            path = self.root / name
            outside = Path(name).is_absolute() or not path.resolve().is_relative_to(self.root)
            path.is_file()  # raises for impossible names and for missing permissions
        except (OSError, ValueError, RuntimeError) as error:  # a NUL byte, a name too long, a loop of links
            raise CaptureError(
                f"cannot use the path {name[:80]!r} ({getattr(error, 'strerror', None) or error})",
                file=source,
                field=field,
                remedy="Give a plain path inside the capture.",
            ) from error
        if outside:
            raise CaptureError(
                f"the path {name!r} leads outside the capture",
                file=source,
                field=field,
                remedy="Use paths relative to the capture folder and put the files themselves into it, not links.",
            )
        return path

    def has(self, name: str) -> bool:
        """Whether `name` is a regular file of the capture."""
        return self.locate(name, source=name).is_file()

    def read(self, name: str) -> bytes:
        """Contents of a file, which then counts towards `digest`."""
        path = self.locate(name, source=name)
        try:
            if not path.is_file():
                raise CaptureError("is missing or not a regular file", file=name, remedy="Add it to the capture.")
            if not is_utf8(name):  # OpenImageIO opens no other names
                raise CaptureError(
                    "has a name that is not UTF-8", file=name, remedy="Rename it, also where it is listed."
                )
            data = path.read_bytes()
        except OSError as error:
            raise CaptureError(
                f"cannot be read ({error.strerror})", file=name, remedy="Check the file and its permissions."
            ) from error
        self._digests[name] = hashlib.sha256(data).hexdigest()
        return data

    def find(self, name: str, *, source: str, field: str | None = None) -> str | None:
        """The file that `name` means, relative to `root` (`FileNames`); None without one.

        Raises `CaptureError` where the name leads outside the capture or is ambiguous.
        """
        for candidate in self._names.candidates(name):
            path = self.locate(candidate, source=source, field=field)
            if path.is_file():
                relative = path.relative_to(self.root)
                return (path.resolve().relative_to(self.root) if ".." in relative.parts else relative).as_posix()
        similar = self._names.similar(name, source=source, field=field)
        if similar is not None:
            self.locate(similar, source=source, field=field)  # it may be a link that leads outside
            self._respelled[name] = similar
        return similar

    def find_image(self, name: str, *, source: str, field: str | None = None) -> ImageFile | None:
        """The image `name`, which may lack its extension; checked to be complete, not decoded. None without one.

        Raises `CaptureError` where it is truncated, too large or in an unsupported format.
        """
        relative = self.find(name, source=source, field=field)
        if relative is None:
            return None
        if relative not in self._images:
            self._images[relative] = check_image(self.root / relative, relative, self.read(relative))
        return self._images[relative]

    def image(self, name: str, *, source: str, field: str | None = None) -> ImageFile:
        """As `find_image`. Raises `CaptureError` where there is none, too."""
        image = self.find_image(name, source=source, field=field)
        if image is None:
            raise CaptureError(
                f"the image {name!r} is missing (tried without and with the extensions {', '.join(SUFFIXES)})",
                file=source,
                field=field,
                remedy="Add the image or remove its entry.",
            )
        return image

    def pictures(self, place: str) -> list[str]:
        """Names of the pictures in the folder `place`, relative to `root`, sorted; not those of folders in it."""
        if place not in self._pictures:
            path = self.root / place
            files = path.iterdir() if path.is_dir() else ()
            shown = (file for file in files if file.suffix.lower() in SUFFIXES and not file.name.startswith("."))
            self._pictures[place] = sorted(f"{place}/{file.name}" for file in shown)
        return self._pictures[place]

    def notes(self) -> list[str]:
        """What was assumed about the names of the files read so far."""
        notes = []
        if self._respelled:
            name, found = next(iter(self._respelled.items()))
            notes.append(
                f"{len(self._respelled)} names are spelled differently on disk and were matched, {name} with {found}"
            )
        return notes

    def digest(self) -> str:
        """sha256 over names and contents of every file read so far."""
        lines = (f"{digest} {name}\n" for name, digest in sorted(self._digests.items()))
        return hashlib.sha256("".join(lines).encode()).hexdigest()
