"""Archives: unpack an untrusted zip or tar, or refuse it.

Only plain files and folders are written, only below the target folder, and only up to the limits. Sizes and counts that
the archive declares are not trusted.
"""

from __future__ import annotations

import errno
import gzip
import lzma
import os
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from graings.capture.image_file import SUFFIXES as IMAGE_SUFFIXES
from graings.capture.image_file import UNREADABLE_SUFFIXES
from graings.capture.readers.foreign import MARKER_SUFFIXES
from graings.capture.readers.rig import VIDEO_SUFFIXES
from service.problems import ArchiveError

# Suffixes of the files of a capture; all other files are skipped. What is recognised and not read is unpacked too: the
# reader then gives the same reason as on the command line.
_DATA = (".json", ".txt", ".ply", ".bin", ".npy", ".npz")
SUFFIXES = frozenset((*_DATA, *IMAGE_SUFFIXES, *UNREADABLE_SUFFIXES, *MARKER_SUFFIXES, *VIDEO_SUFFIXES))
_CHUNK = 1 << 20
_MAX_DEPTH = 16
_MAX_NAME = 255
# Bytes of a whole path. Linux allows 4096, including the folder of the store.
_MAX_PATH = 2_048
# Bytes of extension headers before one entry of a tar, with global headers: at most 4 KB for a path, the rest for times
# and attributes.
_MAX_HEADERS = 64 << 10
_HEADERS = (
    *(tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK),
    *(tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE),
)
# Bytes of the directory of a zip: for each allowed entry ten times its usual size, plus room for a few entries with
# names and comments of the greatest length (196 KB each).
_DIRECTORY_PER_ENTRY = 1 << 10
_DIRECTORY_EXTRA = 1 << 20
_RATIO_FROM = 16 << 20  # below this size, any ratio is harmless
_DECODING_ERRORS = (
    zipfile.BadZipFile,
    tarfile.TarError,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    NotImplementedError,
    RuntimeError,
    UnicodeError,
    ValueError,
    IndexError,
    gzip.BadGzipFile,
)
_NEGATIVE = "The archive is damaged: an entry has a negative size. Pack the capture again."
# Errors of reading at an offset from a damaged header; any other, such as a full disk, is not the archive's.
_BAD_OFFSET = (errno.EINVAL, errno.EOVERFLOW)


@dataclass(frozen=True, slots=True)
class Limits:
    """Greatest number of files, of bytes in all, and of bytes per byte of the archive."""

    files: int
    bytes: int
    ratio: int = 200


@dataclass(frozen=True, slots=True)
class Unpacked:
    """Files and bytes written, and entries skipped because they are no files of a capture."""

    files: int
    bytes: int
    skipped: int


@dataclass(frozen=True, slots=True)
class _Entry:
    """A plain file in an archive."""

    name: str
    stream: IO[bytes]


def unpack(archive: Path, folder: Path, limits: Limits) -> Unpacked:
    """Unpack into `folder`, which must not exist. After an error (`ArchiveError`) nothing remains."""
    folder.mkdir()
    try:
        return _unpack(archive, folder, limits)
    except _DECODING_ERRORS as error:
        shutil.rmtree(folder)
        raise ArchiveError(f"The archive is damaged: {error}. Pack the capture again.") from error
    except BaseException as error:
        shutil.rmtree(folder)
        if isinstance(error, OSError) and error.errno in _BAD_OFFSET:
            raise ArchiveError(f"The archive is damaged: {error}. Pack the capture again.") from error
        raise


def _unpack(archive: Path, folder: Path, limits: Limits) -> Unpacked:
    packed = max(1, archive.stat().st_size)
    files = total = skipped = 0
    seen: set[str] = set()
    for entry in _entries(archive, limits):
        path = _checked(entry.name, seen)
        if not _is_capture_file(path):
            skipped += 1
            continue
        files += 1
        with _created(folder.joinpath(*path.parts), entry.name) as out:
            while chunk := entry.stream.read(_CHUNK):
                total += len(chunk)
                if total > limits.bytes:
                    raise ArchiveError(f"The archive unpacks to more than {limits.bytes} bytes.")
                if total > _RATIO_FROM and total > limits.ratio * packed:
                    raise ArchiveError(f"The archive unpacks to more than {limits.ratio} times its size.")
                out.write(chunk)
    if files == 0:
        raise ArchiveError("The archive has no file of a capture. Pack transforms files or a COLMAP model, and images.")
    return Unpacked(files, total, skipped)


def _created(target: Path, name: str) -> IO[bytes]:
    """The new file `target`, open for writing, with its folders. Raises `ArchiveError` naming the entry `name`."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644)
    except (FileExistsError, NotADirectoryError) as error:
        raise ArchiveError(f"{name!r} is both a file and a folder. Pack the capture again.") from error
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        # Some file systems allow less than Linux does, and the folder of the store may be deep itself.
        raise ArchiveError(f"{name[:80]!r}… is too long for the disk of the service. Use shorter names.") from error
    return os.fdopen(handle, "wb")


def _entries(archive: Path, limits: Limits) -> Iterator[_Entry]:
    with archive.open("rb") as file:
        head = file.read(512)
    if head[:2] == b"PK":
        yield from _zip_entries(archive, limits)
    elif head[257:262] == b"ustar" or head[:2] == b"\x1f\x8b":
        yield from _tar_entries(archive, limits)
    else:
        raise ArchiveError("The body is not an archive. Send a zip, tar or tar.gz.")


def _zip_entries(archive: Path, limits: Limits) -> Iterator[_Entry]:
    with archive.open("rb") as file:
        _check_directory(file, limits)
    with zipfile.ZipFile(archive) as source:
        _check_count(len(source.infolist()), limits)
        for info in source.infolist():
            kind = stat.S_IFMT(info.external_attr >> 16)
            if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise ArchiveError(f"{info.filename!r} is a link or a device. Only plain files are accepted.")
            if info.flag_bits & 1:
                raise ArchiveError(f"{info.filename!r} is encrypted. Pack the capture without a password.")
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ArchiveError(f"{info.filename!r} uses an unsupported compression. Use deflate.")
            if not info.is_dir():
                with source.open(info) as stream:
                    yield _Entry(info.filename, stream)


def _check_directory(file: IO[bytes], limits: Limits) -> None:
    """Refuse a zip with too many entries before zipfile reads its whole directory and creates an object for each."""
    end = zipfile._EndRecData(file)  # type: ignore[attr-defined]  # as zipfile itself finds it
    if end is None:
        return  # zipfile raises the error
    wide, declared, size, place = end[0] == zipfile.stringEndArchive64, end[4], end[5], end[9]  # type: ignore[attr-defined]
    _check_count(declared, limits)
    most = limits.files * _DIRECTORY_PER_ENTRY + _DIRECTORY_EXTRA
    if size > most:
        raise ArchiveError(
            f"The archive's list of entries is damaged or takes more than {most} bytes. "
            "Use shorter names and no comments, or pack the capture again."
        )
    # zipfile ignores the declared number, which may be wrong: count the records themselves.
    start = place - size
    if wide:
        start -= zipfile.sizeEndCentDir64 + zipfile.sizeEndCentDir64Locator  # type: ignore[attr-defined]
    file.seek(max(0, start))
    _check_count(file.read(size).count(zipfile.stringCentralDir), limits)  # type: ignore[attr-defined]


def _tar_entries(archive: Path, limits: Limits) -> Iterator[_Entry]:
    with tarfile.open(archive, "r:*", tarinfo=_bounded_headers()) as source:
        declared = 0
        for number, member in enumerate(iter(source.next, None), start=1):
            # Otherwise tarfile keeps every entry with all its headers.
            source.members.clear()  # type: ignore[attr-defined]
            _check_count(number, limits)
            if member.size < 0:
                raise ArchiveError(_NEGATIVE)  # reading would move backwards
            # Skipped entries count too: to skip them is to decompress them.
            declared += member.size
            if declared > limits.bytes:
                raise ArchiveError(f"The archive unpacks to more than {limits.bytes} bytes.")
            if not (member.isreg() or member.isdir()) or member.issparse():
                raise ArchiveError(f"{member.name!r} is a link or a device. Only plain files are accepted.")
            if member.isreg():
                stream = source.extractfile(member)
                assert stream is not None  # true for every regular file
                yield _Entry(member.name, stream)


def _bounded_headers() -> type[tarfile.TarInfo]:
    """A class of headers for one archive that raises `ArchiveError` before tarfile reads too much into memory.

    tarfile reads any number of long names, pax headers and maps of sparse files, each as a whole, before it returns an
    entry.
    """
    local_bytes = global_bytes = 0  # of the headers since the last entry, and of the global headers so far

    class Header(tarfile.TarInfo):
        def _proc_member(self, archive: tarfile.TarFile) -> tarfile.TarInfo:
            """tarfile calls this for every header, before it reads what follows."""
            nonlocal local_bytes, global_bytes
            if self.type == tarfile.GNUTYPE_SPARSE:
                raise ArchiveError(_sparse(self.name))
            if self.type not in _HEADERS:
                local_bytes = 0
            elif self.size < 0:
                raise ArchiveError(_NEGATIVE)  # tarfile would read to the end of the file
            elif self.type == tarfile.XGLTYPE:
                global_bytes += self.size
            else:
                local_bytes += self.size
            if local_bytes + global_bytes > _MAX_HEADERS:
                raise ArchiveError(
                    f"The archive has headers of more than {_MAX_HEADERS} bytes before one entry. "
                    "Pack the capture without extended attributes."
                )
            return super()._proc_member(archive)  # type: ignore[misc]

        def _proc_gnusparse_10(self, following: tarfile.TarInfo, *_: object) -> None:
            """tarfile calls this to read the map of a sparse file that a pax header announces."""
            raise ArchiveError(_sparse(following.name))

    return Header


def _sparse(name: str) -> str:
    return f"{name!r} is a sparse file. Pack the capture without --sparse."


def _check_count(number: int, limits: Limits) -> None:
    if number > limits.files:
        raise ArchiveError(f"The archive has more than {limits.files} entries.")


def _checked(name: str, seen: set[str]) -> PurePosixPath:
    """The path of an entry, checked to be inside the archive, short enough, and not in `seen`."""
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or ":" in name or any(ord(c) < 32 for c in name) or not path.parts:
        raise ArchiveError(f"{name!r} points outside of the archive or is not a name. Pack the capture again.")
    try:
        sizes = [len(part.encode()) for part in path.parts]
    except UnicodeEncodeError as error:
        # tarfile decodes such bytes to lone surrogates, which no JSON document in UTF-8 can contain.
        raise ArchiveError(f"{name!r} is not UTF-8. Rename it, or pack the capture with names in UTF-8.") from error
    if len(sizes) > _MAX_DEPTH or max(sizes) > _MAX_NAME or sum(sizes) + len(sizes) > _MAX_PATH:
        raise ArchiveError(f"{name[:80]!r}… is too long or too deep. Use shorter names and fewer folders.")
    # On a file system that ignores case, one would overwrite the other.
    key = str(path).casefold()
    if key in seen:
        raise ArchiveError(f"{name!r} is in the archive twice. Pack the capture again.")
    seen.add(key)
    return path


def _is_capture_file(path: PurePosixPath) -> bool:
    hidden = any(part.startswith(".") or part == "__MACOSX" for part in path.parts)
    return not hidden and path.suffix.lower() in SUFFIXES
