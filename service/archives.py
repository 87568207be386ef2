"""Archives: unpack a zip or tar that a stranger sent, or refuse it.

Only plain files and folders come out, only below the target, only as much as the limits allow; what an archive says
about itself is not believed. Knows nothing of HTTP.
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

from service.problems import ArchiveError

# What a capture is made of; anything else in the archive is left out.
_DATA = (".json", ".txt", ".ply", ".bin", ".npy", ".npz")
_IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".tif", ".tiff", ".bmp", ".tga", ".hdr")
SUFFIXES = frozenset((*_DATA, *_IMAGES))
_CHUNK = 1 << 20
_MAX_DEPTH = 16
_MAX_NAME = 255
# Bytes of a whole path. Linux takes 4096, and the folder of the store comes before it.
_MAX_PATH = 2_048
# Bytes that a tar may put before one entry, global headers included, to say more of it than fits its own header: a path
# takes 4 KB at most, the rest is for times and attributes.
_MAX_HEADERS = 64 << 10
_HEADERS = (
    *(tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK),
    *(tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE),
)
# Bytes that the directory of a zip may take: a share for each entry that is allowed, which is ten times what one needs,
# and a rest in which a few entries have room with names and comments as long as the format lets them be (196 KB).
_DIRECTORY_PER_ENTRY = 1 << 10
_DIRECTORY_REST = 1 << 20
_RATIO_FROM = 16 << 20  # below this much, any ratio is harmless
_BROKEN = (
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
# What reading says of a place that a damaged header points to; a full disk is no fault of the archive.
_NOWHERE = (errno.EINVAL, errno.EOVERFLOW)


@dataclass(frozen=True, slots=True)
class Limits:
    """How much may come out of an archive."""

    files: int
    bytes: int
    ratio: int = 200


@dataclass(frozen=True, slots=True)
class Unpacked:
    """What came out, and how many entries were left out because a capture has no such files."""

    files: int
    bytes: int
    skipped: int


@dataclass(frozen=True, slots=True)
class _Entry:
    """A plain file in an archive."""

    name: str
    stream: IO[bytes]


def unpack(archive: Path, folder: Path, limits: Limits) -> Unpacked:
    """Unpack into `folder`, which is made and must not exist. Raises `ArchiveError` and leaves nothing behind."""
    folder.mkdir()
    try:
        return _unpack(archive, folder, limits)
    except _BROKEN as error:
        shutil.rmtree(folder)
        raise ArchiveError(f"The archive is damaged: {error}. Pack the capture again.") from error
    except BaseException as error:
        shutil.rmtree(folder)
        if isinstance(error, OSError) and error.errno in _NOWHERE:
            raise ArchiveError(f"The archive is damaged: {error}. Pack the capture again.") from error
        raise


def _unpack(archive: Path, folder: Path, limits: Limits) -> Unpacked:
    packed = max(1, archive.stat().st_size)
    files = total = skipped = 0
    seen: set[str] = set()
    for entry in _entries(archive, limits):
        path = _checked(entry.name, seen)
        if not _wanted(path):
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
        raise ArchiveError(
            "There is no file of a capture in the archive: transforms files or a COLMAP model, and images."
        )
    return Unpacked(files, total, skipped)


def _created(target: Path, name: str) -> IO[bytes]:
    """The new file `target`, open for writing, its folders made. Raises `ArchiveError` about the entry `name`."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644)
    except (FileExistsError, NotADirectoryError) as error:
        raise ArchiveError(f"{name!r} is both a file and a folder. Pack the capture again.") from error
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        # Some file systems take less than Linux does, and the folder of the store may lie deep itself.
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
        raise ArchiveError("The body is no archive. Send a zip, a tar or a tar.gz.")


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
                raise ArchiveError(f"{info.filename!r} is compressed in an unusual way. Use deflate.")
            if not info.is_dir():
                with source.open(info) as stream:
                    yield _Entry(info.filename, stream)


def _check_directory(file: IO[bytes], limits: Limits) -> None:
    """Refuse a zip with too many entries before zipfile reads its directory whole and makes an object of each."""
    end = zipfile._EndRecData(file)  # type: ignore[attr-defined]  # what zipfile itself goes by
    if end is None:
        return  # zipfile says what is wrong
    wide, declared, size, place = end[0] == zipfile.stringEndArchive64, end[4], end[5], end[9]  # type: ignore[attr-defined]
    _check_count(declared, limits)
    most = limits.files * _DIRECTORY_PER_ENTRY + _DIRECTORY_REST
    if size > most:
        raise ArchiveError(
            f"The archive's list of entries is damaged or takes more than {most} bytes. "
            "Use shorter names and no comments, or pack the capture again."
        )
    # The declared number may be a lie that zipfile does not look at: count the records themselves.
    start = place - size
    if wide:
        start -= zipfile.sizeEndCentDir64 + zipfile.sizeEndCentDir64Locator  # type: ignore[attr-defined]
    file.seek(max(0, start))
    _check_count(file.read(size).count(zipfile.stringCentralDir), limits)  # type: ignore[attr-defined]


def _tar_entries(archive: Path, limits: Limits) -> Iterator[_Entry]:
    with tarfile.open(archive, "r:*", tarinfo=_bounded_headers()) as source:
        declared = 0
        for number, member in enumerate(iter(source.next, None), start=1):
            # tarfile would keep every entry with all that its headers say of it.
            source.members.clear()  # type: ignore[attr-defined]
            _check_count(number, limits)
            if member.size < 0:
                raise ArchiveError(_NEGATIVE)  # it would lead backwards
            # Also of what is left out: passing over it means unpacking it.
            declared += member.size
            if declared > limits.bytes:
                raise ArchiveError(f"The archive unpacks to more than {limits.bytes} bytes.")
            if not (member.isreg() or member.isdir()) or member.issparse():
                raise ArchiveError(f"{member.name!r} is a link or a device. Only plain files are accepted.")
            if member.isreg():
                stream = source.extractfile(member)
                assert stream is not None  # so for every regular file
                yield _Entry(member.name, stream)


def _bounded_headers() -> type[tarfile.TarInfo]:
    """A class of headers for one archive that raises `ArchiveError` where tarfile would read too much into memory.

    Long names, pax headers and maps of sparse files are read whole, in any number, before an entry comes out.
    """
    ahead = lasting = 0  # bytes of headers since the last entry, and of global ones, which stay

    class Header(tarfile.TarInfo):
        def _proc_member(self, archive: tarfile.TarFile) -> tarfile.TarInfo:
            """What tarfile lets a subclass override: called with every header, before what follows it is read."""
            nonlocal ahead, lasting
            if self.type == tarfile.GNUTYPE_SPARSE:
                raise ArchiveError(_sparse(self.name))
            if self.type not in _HEADERS:
                ahead = 0
            elif self.size < 0:
                raise ArchiveError(_NEGATIVE)  # which reads everything to the end
            elif self.type == tarfile.XGLTYPE:
                lasting += self.size
            else:
                ahead += self.size
            if ahead + lasting > _MAX_HEADERS:
                raise ArchiveError(
                    f"The archive has headers of more than {_MAX_HEADERS} bytes before one entry. "
                    "Pack the capture without extended attributes."
                )
            return super()._proc_member(archive)  # type: ignore[misc]

        def _proc_gnusparse_10(self, following: tarfile.TarInfo, *_: object) -> None:
            """Where tarfile would read the map of a sparse file that a pax header speaks of."""
            raise ArchiveError(_sparse(following.name))

    return Header


def _sparse(name: str) -> str:
    return f"{name!r} is a sparse file. Pack the capture without --sparse."


def _check_count(number: int, limits: Limits) -> None:
    if number > limits.files:
        raise ArchiveError(f"The archive has more than {limits.files} entries.")


def _checked(name: str, seen: set[str]) -> PurePosixPath:
    """The entry's path, relative and without tricks."""
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or ":" in name or any(ord(c) < 32 for c in name) or not path.parts:
        raise ArchiveError(f"{name!r} points outside of the archive or is no name. Pack the capture again.")
    try:
        sizes = [len(part.encode()) for part in path.parts]
    except UnicodeEncodeError as error:
        # tarfile hands on bytes that it cannot decode as halves of characters; no document could quote such a name.
        raise ArchiveError(f"{name!r} is not UTF-8. Rename it, or pack the capture with names in UTF-8.") from error
    if len(sizes) > _MAX_DEPTH or max(sizes) > _MAX_NAME or sum(sizes) + len(sizes) > _MAX_PATH:
        raise ArchiveError(f"{name[:80]!r}… is too long or too deep. Use shorter names and fewer folders.")
    # Where case does not count, one of two would overwrite the other.
    key = str(path).casefold()
    if key in seen:
        raise ArchiveError(f"{name!r} is in the archive twice. Pack the capture again.")
    seen.add(key)
    return path


def _wanted(path: PurePosixPath) -> bool:
    hidden = any(part.startswith(".") or part == "__MACOSX" for part in path.parts)
    return not hidden and path.suffix.lower() in SUFFIXES
