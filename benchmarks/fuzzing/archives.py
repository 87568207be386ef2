"""Archives: zip, tar and tar.gz of a capture, with every lie that their formats allow, unpacked as uploads are."""

from __future__ import annotations

import gzip
import io
import shutil
import struct
import tarfile
import warnings
import zipfile
from functools import cache
from pathlib import Path
from random import Random

from fuzzing.mutations import EXTREMES, TEXTS, WIDE, mutated
from service.archives import Limits, unpack

LIMITS = Limits(files=50, bytes=2_000_000)
NAMES = (
    *("transforms_train.json", "train/r_0.png", "A/x.json", "a/X.json", "x.json", "x.json/y.json", "./x.json", "d/"),
    *("../evil.json", "a/../../evil.json", "/evil.json", "//x.json", "a//b.json", "..\\evil.json", "C:\\evil.json"),
    *("a/./b.json", "x.json.", " x.json", "x.json\0.png", ".hidden/x.json", "d" * 300 + ".json", "e/" * 40 + "x.json"),
)


class Damage(Exception):
    """Something that an unpacked archive must never leave."""


def name_of(rng: Random) -> str:
    return rng.choice(NAMES) if rng.random() < 0.8 else rng.choice(TEXTS)[:60_000]


def content_of(rng: Random) -> bytes:
    return rng.choice(
        (b"{}", b"", rng.randbytes(300), b"\0" * 100_000, b"\0" * 3_000_000 if rng.random() < 0.1 else b"x")
    )


def zipped(rng: Random) -> bytes:
    """A zip with entries of hostile names, kinds and compressions."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about names that occur twice
        for number in range(rng.choice((1, 2, 3, 60))):
            name = name_of(rng).encode("utf-8", "replace").decode() if rng.random() < 0.5 else f"{number}.json"
            info = zipfile.ZipInfo(name[:65_000] or "x")
            info.external_attr = rng.choice((0, 0o100644, 0o120777, 0o010644, 0o020644, 0o060644, 0o140644)) << 16
            info.extra = rng.choice((b"", struct.pack("<2H", 1, 24) + b"\xff" * 24, rng.randbytes(9), b"\1\0\xff\xff"))
            if rng.random() < 0.05:
                info.comment = rng.randbytes(60_000)
            method = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
            archive.writestr(info, content_of(rng), compress_type=method)
        archive.comment = rng.choice((b"", b"x" * 1_000))
    return target.getvalue()


def lying_zip(data: bytes, rng: Random) -> bytes:
    """A field of a header replaced: sizes, offsets (entries that overlap), flags (encrypted), methods, counts."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        signature, fields = rng.choice(
            (
                (b"PK\1\2", ((8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (32, 2), (38, 4), (42, 4))),
                (b"PK\3\4", ((6, 2), (8, 2), (14, 4), (18, 4), (22, 4), (26, 2), (28, 2))),
                (b"PK\5\6", ((4, 2), (8, 2), (10, 2), (12, 4), (16, 4), (20, 2))),
            )
        )
        places = [at for at in range(len(changed) - 46) if changed[at : at + 4] == signature] or [len(changed) - 22]
        place, (offset, size) = rng.choice(places), rng.choice(fields)
        other = rng.choice(places)
        value = rng.choice((rng.choice(EXTREMES), other, len(data), 1)) % (1 << 8 * size)
        if 0 <= place + offset <= len(changed) - size:
            changed[place + offset : place + offset + size] = value.to_bytes(size, "little")
    return bytes(changed)


def tarred(rng: Random) -> bytes:
    """A tar with links, devices, sparse files and extended headers."""
    kinds = (tarfile.REGTYPE,) * 6 + (
        b"\0",
        b"1",
        b"2",
        b"3",
        b"4",
        b"5",
        b"6",
        b"7",
        b"L",
        b"K",
        b"x",
        b"g",
        b"S",
        b"X",
    )
    target = io.BytesIO()
    format = rng.choice((tarfile.GNU_FORMAT, tarfile.PAX_FORMAT, tarfile.USTAR_FORMAT))
    with tarfile.open(fileobj=target, mode="w", format=format, errors="surrogateescape") as archive:
        for number in range(rng.choice((1, 2, 3, 60))):
            name = name_of(rng).encode("utf-8", "replace").decode() if rng.random() < 0.5 else f"{number}.json"
            info = tarfile.TarInfo(name[:90] if format == tarfile.USTAR_FORMAT else name[:70_000])
            info.type, content = rng.choice(kinds), content_of(rng)
            info.linkname, info.size = rng.choice(("", "/etc/passwd", "../x", "x.json")), len(content)
            if format == tarfile.PAX_FORMAT and rng.random() < 0.3:
                key = rng.choice(
                    ("size", "path", "linkpath", "mtime", "GNU.sparse.major", "GNU.sparse.map", "hdrcharset")
                )
                value = rng.choice((*TEXTS[:16], *map(str, WIDE), "1,2", "BINARY"))
                info.pax_headers = {key: value.encode("utf-8", "replace").decode()}
            try:
                archive.addfile(info, io.BytesIO(content))
            except (ValueError, UnicodeError):  # what the format cannot write
                archive.addfile(tarfile.TarInfo(f"{number}.json"))
    return target.getvalue()


def lying_tar(data: bytes, rng: Random) -> bytes:
    """A header with another size or kind and the right check sum."""
    changed = bytearray(data)
    headers = [at for at in range(0, len(data) - 511, 512) if data[at + 257 : at + 262] == b"ustar"]
    place = rng.choice(headers or [0])
    if len(changed) < place + 512:
        return data
    if rng.random() < 0.6:
        value = rng.choice(WIDE)
        text = b"%011o\0" % value if 0 <= value < 8**11 else b"\x80" + (value % (1 << 88)).to_bytes(11, "big")
        changed[place + 124 : place + 136] = rng.choice((text, b"-0000000001\0", b"9" * 12, b" " * 12, b"\xff" * 12))
    else:
        changed[place + 156] = rng.randrange(256)
    changed[place + 148 : place + 156] = b" " * 8
    changed[place + 148 : place + 156] = b"%06o\0 " % sum(changed[place : place + 512])
    return bytes(changed)


@cache
def valid() -> tuple[tuple[str, bytes], ...]:
    """A zip, a tar and a tar.gz of the same two files."""
    files = {"transforms_train.json": b'{"frames": []}', "train/r_0.png": bytes(range(256))}
    packed, taped = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive, tarfile.open(fileobj=taped, mode="w") as tape:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content)
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tape.addfile(info, io.BytesIO(content))
    return tuple(("archive", data) for data in (packed.getvalue(), taped.getvalue(), gzip.compress(taped.getvalue())))


@cache
def seeds() -> tuple[bytes, ...]:
    rng = Random("archives")
    return (*(data for _, data in valid()), *(make(rng) for make in (zipped, tarred) for _ in range(8)))


def make(rng: Random) -> tuple[str, bytes]:
    if rng.random() < 0.3:
        return "archive", mutated(rng.choice(valid())[1], rng, seeds())
    is_zip = rng.random() < 0.5
    data = zipped(rng) if is_zip else tarred(rng)
    kind = rng.random()
    if kind < 0.45:
        data = lying_zip(data, rng) if is_zip else lying_tar(data, rng)
    elif kind < 0.85:
        data = mutated(data, rng, seeds())
    if not is_zip and rng.random() < 0.3:
        data = gzip.compress(data, compresslevel=1)
        data = mutated(data, rng, seeds()) if rng.random() < 0.3 else data
    return "archive", data


def open_folder(folder: Path) -> Path:
    (folder / "inner").mkdir()
    return folder / "inner"


def read(inner: Path, name: str, data: bytes) -> None:
    """Unpack; whatever happens, nothing may lie outside of the folder and nothing but plain files and folders in it."""
    archive, out = inner / name, inner / "out"
    archive.write_bytes(data)
    try:
        unpacked = unpack(archive, out, LIMITS)
    except BaseException:
        if out.exists():
            shutil.rmtree(out)
            raise Damage("a refused archive left files") from None
        raise
    finally:
        if {path.name for path in inner.iterdir()} - {"archive", "out"} or [p.name for p in inner.parent.iterdir()] != [
            "inner"
        ]:
            raise Damage("a file outside of the folder")
    files = [path for path in out.rglob("*") if not path.is_dir() or path.is_symlink()]
    plain = all(path.is_file() and not path.is_symlink() for path in files)
    size = sum(path.stat().st_size for path in files)
    shutil.rmtree(out)
    if not plain or len(files) != unpacked.files or size != unpacked.bytes or size > LIMITS.bytes:
        raise Damage("what was unpacked is not what was counted")
