"""Untrusted archives: each is built in the test."""

from __future__ import annotations

import gzip
import io
import os
import shutil
import struct
import tarfile
import tracemalloc
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from service.archives import Limits, unpack
from service.problems import ArchiveError

LIMITS = Limits(files=50, bytes=50_000_000)


def zipped(path: Path, entries: dict[str, bytes], **options: int) -> Path:
    with zipfile.ZipFile(path, "w", **options) as archive:  # type: ignore[arg-type]
        for name, content in entries.items():
            archive.writestr(name, content)
    return path


def tarred(path: Path, *members: tuple[tarfile.TarInfo, bytes], mode: str = "w") -> Path:
    with tarfile.open(path, mode) as archive:  # type: ignore[call-overload]
        for info, content in members:
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return path


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type = kind
    info.linkname = link
    return info


def refused(archive: Path, limits: Limits = LIMITS) -> str:
    """The message with which an archive is refused; it must leave no files, inside or outside of its folder."""
    before = sorted(archive.parent.rglob("*"))
    with pytest.raises(ArchiveError) as caught:
        unpack(archive, archive.parent / "out", limits)
    assert sorted(archive.parent.rglob("*")) == before
    return str(caught.value)


@pytest.mark.parametrize("mode", ["zip", "w:gz"])
def test_any_damaged_byte_is_refused_or_harmless(tmp_path: Path, mode: str) -> None:
    """Otherwise an unexpected error class of a library would be an error of the service."""
    files = {"transforms_train.json": b'{"frames": []}', "train/r_0.png": bytes(range(256))}
    if mode == "zip":
        archive = zipped(tmp_path / "whole", files, compression=zipfile.ZIP_DEFLATED)
    else:
        archive = tarred(tmp_path / "whole", *((member(name), content) for name, content in files.items()), mode=mode)
    content, refusals = archive.read_bytes(), 0
    for place in range(len(content)):
        for flip in (0x01, 0x80, 0xFF):
            damaged = bytearray(content)
            damaged[place] ^= flip
            (tmp_path / "damaged").write_bytes(damaged)
            try:
                unpack(tmp_path / "damaged", tmp_path / "out", LIMITS)
            except ArchiveError:
                refusals += 1
            else:
                shutil.rmtree(tmp_path / "out")
            assert not (tmp_path / "out").exists()
    assert refusals > len(content)


@pytest.mark.parametrize("mode", ["zip", "w", "w:gz"])
def test_a_capture_is_unpacked_unchanged(tmp_path: Path, mode: str) -> None:
    files = {"scene/transforms_train.json": b"{}", "scene/train/r_0.png": os.urandom(3_000)}
    if mode == "zip":
        archive = zipped(tmp_path / "a", files, compression=zipfile.ZIP_DEFLATED)
    else:
        archive = tarred(tmp_path / "a", *((member(name), content) for name, content in files.items()), mode=mode)
    unpacked = unpack(archive, tmp_path / "out", LIMITS)
    assert (unpacked.files, unpacked.bytes, unpacked.skipped) == (2, 3_002, 0)
    assert {str(p.relative_to(tmp_path / "out")): p.read_bytes() for p in (tmp_path / "out").rglob("*.*")} == files


def test_files_that_a_capture_does_not_have_are_skipped(tmp_path: Path) -> None:
    files = {"a.json": b"{}", "run.sh": b"#!", "__MACOSX/a.json": b"x", ".git/b.json": b"x", "noending": b"x"}
    unpacked = unpack(zipped(tmp_path / "a", files), tmp_path / "out", LIMITS)
    assert (unpacked.files, unpacked.skipped) == (1, 4)
    assert [path.name for path in (tmp_path / "out").rglob("*")] == ["a.json"]


@pytest.mark.parametrize(
    "name", ["../evil.json", "a/../../evil.json", "/evil.json", "..\\evil.json", "C:\\evil.json", "a\nb.json"]
)
def test_a_path_that_leads_out_is_refused(tmp_path: Path, name: str) -> None:
    assert "outside" in refused(zipped(tmp_path / "a", {"good.json": b"{}", name: b"{}"}))
    (tmp_path / "a").unlink()
    assert "outside" in refused(tarred(tmp_path / "a", (member("good.json"), b"{}"), (member(name), b"{}")))


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE])
def test_links_and_devices_in_a_tar_are_refused(tmp_path: Path, kind: bytes) -> None:
    assert "plain files" in refused(tarred(tmp_path / "a", (member("x.json", kind, "/etc/passwd"), b"")))


def test_a_symbolic_link_in_a_zip_is_refused(tmp_path: Path) -> None:
    info = zipfile.ZipInfo("x.json")
    info.external_attr = 0o120777 << 16
    with zipfile.ZipFile(tmp_path / "a", "w") as archive:
        archive.writestr(info, "/etc/passwd")
    assert "plain files" in refused(tmp_path / "a")


def test_a_bomb_is_refused_by_its_ratio_and_by_its_size(tmp_path: Path) -> None:
    bomb = {"zeros.json": bytes(30_000_000)}
    archive = zipped(tmp_path / "a", bomb, compression=zipfile.ZIP_DEFLATED)
    assert "times its size" in refused(archive)
    assert "more than 1000 bytes" in refused(archive, Limits(files=9, bytes=1_000))
    archive.unlink()
    archive = tarred(tmp_path / "a", (member("zeros.unwanted"), bytes(2_000_000)), mode="w:gz")
    assert "more than 1000 bytes" in refused(archive, Limits(files=9, bytes=1_000))


def test_a_zip_with_wrong_sizes_is_refused(tmp_path: Path) -> None:
    archive = zipped(tmp_path / "a", {"a.json": b"x" * 5_000}, compression=zipfile.ZIP_DEFLATED)
    content = archive.read_bytes()
    claimed = (5_000).to_bytes(4, "little")
    assert content.count(claimed) == 2  # in the local header and in the directory
    archive.write_bytes(content.replace(claimed, (100).to_bytes(4, "little")))
    assert "damaged" in refused(archive)


@pytest.mark.parametrize("share", [0.2, 0.6, 0.99])
@pytest.mark.parametrize("kind", ["zip", "tar.gz"])
def test_a_truncated_archive_is_refused(tmp_path: Path, kind: str, share: float) -> None:
    noise = os.urandom(20_000)
    if kind == "zip":
        archive = zipped(tmp_path / "a", {"a.json": noise, "b.json": noise})
    else:
        archive = tarred(tmp_path / "a", (member("a.json"), noise), (member("b.json"), noise), mode="w:gz")
    content = archive.read_bytes()
    archive.write_bytes(content[: int(share * len(content))])
    assert "damaged" in refused(archive)


def test_an_encrypted_entry_is_refused(tmp_path: Path) -> None:
    archive = zipped(tmp_path / "a", {"a.json": b"{}"})
    content = bytearray(archive.read_bytes())
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(signature) + flags] |= 1
    archive.write_bytes(content)
    assert "password" in refused(archive)


def test_names_that_collide_are_refused(tmp_path: Path) -> None:
    assert "twice" in refused(zipped(tmp_path / "a", {"A/x.json": b"1", "a/X.json": b"2"}))
    (tmp_path / "a").unlink()
    assert "both a file and a folder" in refused(zipped(tmp_path / "a", {"x.json": b"1", "x.json/y.json": b"2"}))


def test_a_file_that_is_not_an_archive_and_an_empty_archive_are_refused(tmp_path: Path) -> None:
    for content, word in (
        (b"", "not an archive"),
        (b"hello", "not an archive"),
        (b"PK\x03\x04", "damaged"),
        (b"\x1f\x8bx", "damaged"),
    ):
        (tmp_path / "a").write_bytes(content)
        assert word in refused(tmp_path / "a")
    assert "no file of a capture" in refused(zipped(tmp_path / "a", {"readme.md": b"hello"}))


def test_too_many_entries_are_refused(tmp_path: Path) -> None:
    many = {f"{i}.json": b"{}" for i in range(51)}
    assert "more than 50 entries" in refused(zipped(tmp_path / "a", many))
    (tmp_path / "a").unlink()
    assert "more than 50 entries" in refused(tarred(tmp_path / "a", *((member(name), b"") for name in many)))


@contextmanager
def at_most(size: int) -> Iterator[None]:
    """Fails if more than `size` bytes are allocated at any time inside."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < size
    finally:
        tracemalloc.stop()


def header(kind: bytes, size: int, name: str = "x") -> bytes:
    """The header block of an entry of a tar, without its content."""
    info = member(name, kind)
    info.size = size
    return info.tobuf(tarfile.GNU_FORMAT)


EXTENSIONS = (tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK, tarfile.XHDTYPE, tarfile.XGLTYPE, b"X")


@pytest.mark.parametrize("kind", EXTENSIONS)
@pytest.mark.parametrize("size", [32 << 20, -512])
def test_a_header_of_any_size_is_refused_before_it_is_read(tmp_path: Path, kind: bytes, size: int) -> None:
    """tarfile reads these whole, and with a negative size everything to the end."""
    (tmp_path / "a").write_bytes(gzip.compress(header(kind, size) + bytes(32 << 20), compresslevel=1))
    with at_most(4 << 20):
        message = refused(tmp_path / "a")
    assert ("negative size" if size < 0 else "extended attributes") in message


@pytest.mark.parametrize("kind", EXTENSIONS)
def test_many_headers_before_one_entry_count_together(tmp_path: Path, kind: bytes) -> None:
    headers = (header(kind, 30 << 10) + bytes(30 << 10)) * 3
    (tmp_path / "a").write_bytes(headers + header(tarfile.REGTYPE, 0, "x.json") + bytes(1024))
    assert "extended attributes" in refused(tmp_path / "a")


def test_global_headers_count_for_all_entries(tmp_path: Path) -> None:
    each = header(tarfile.XGLTYPE, 30 << 10) + bytes(30 << 10)
    entries = b"".join(each + header(tarfile.REGTYPE, 0, f"{i}.json") for i in range(3))
    (tmp_path / "a").write_bytes(entries + bytes(1024))
    assert "extended attributes" in refused(tmp_path / "a")


def test_headers_are_discarded_after_their_entry(tmp_path: Path) -> None:
    """40 KB for each of 200 entries is allowed, and not kept in memory 200 times."""
    with tarfile.open(tmp_path / "a", "w:gz", format=tarfile.PAX_FORMAT) as archive:
        for number in range(200):
            info = member(f"{number}.json")
            info.pax_headers = {"comment": f"{number}" + "x" * 40_000}
            archive.addfile(info)
    with at_most(4 << 20):
        assert unpack(tmp_path / "a", tmp_path / "out", Limits(files=200, bytes=1)).files == 200


@pytest.mark.parametrize("format", [tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_names_of_the_greatest_length_are_unpacked(tmp_path: Path, format: int) -> None:
    name = "/".join(["d" * 250] * 7) + "/x.json"
    with tarfile.open(tmp_path / "a", "w", format=format) as archive:
        archive.addfile(member(name))
    unpack(tmp_path / "a", tmp_path / "out", LIMITS)
    assert (tmp_path / "out" / name).is_file()


def test_a_sparse_file_is_refused_before_its_map_is_read(tmp_path: Path) -> None:
    """tarfile keeps the map as a list of numbers, of any length."""
    more = struct.pack("504sB7x", b"00000000001\0" * 42, 1)  # a block of the map, with the mark that another follows
    first = bytearray(header(tarfile.GNUTYPE_SPARSE, 0, "x.json"))
    first[482] = 1  # the map goes on after the header
    first[148:156] = b"%06o\0 " % tarfile.calc_chksums(bytes(first))[0]  # type: ignore[attr-defined]
    (tmp_path / "a").write_bytes(bytes(first) + more * 5_000)
    with at_most(1 << 20):
        assert "sparse" in refused(tmp_path / "a")

    info = member("x.json")
    info.pax_headers = {"GNU.sparse.major": "1", "GNU.sparse.minor": "0"}
    numbers = b"1000000\n" + b"1\n" * 2_000_000
    info.size = len(numbers)
    with tarfile.open(tmp_path / "a", "w", format=tarfile.PAX_FORMAT) as archive:
        archive.addfile(info, io.BytesIO(numbers))
    with at_most(1 << 20):
        assert "sparse" in refused(tmp_path / "a")


def test_a_file_of_negative_size_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(header(tarfile.REGTYPE, -512, "x.json") + bytes(1024))
    assert "negative size" in refused(tmp_path / "a")


def directory(records: int, comment: int, declared: int) -> bytes:
    """A zip with only a directory: `records` entries with a comment of `comment` bytes each, declared as `declared`."""
    fields = (b"PK\x01\x02", 20, 3, 20, 0, 0, 0, 0, 33, 0, 0, 0, 1, 0, comment, 0, 0, 0, 0)
    record = struct.pack("<4s4B4H3L5H2L", *fields) + b"a" + b"c" * comment
    size = records * len(record)
    return record * records + struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, declared, declared, size, 0, 0)


@pytest.mark.parametrize("declared", [20_000, 1])
def test_entries_of_a_zip_are_counted_before_they_are_read(tmp_path: Path, declared: int) -> None:
    (tmp_path / "a").write_bytes(directory(20_000, 0, declared))
    with at_most(2 << 20):
        assert "more than 50 entries" in refused(tmp_path / "a")


def test_a_zip_whose_directory_is_far_too_large_is_refused_before_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(directory(40, 60_000, 40))
    with at_most(1 << 20):
        assert "list of entries" in refused(tmp_path / "a")


def test_a_zip_of_few_entries_may_have_comments_of_the_greatest_length(tmp_path: Path) -> None:
    limits = Limits(files=5, bytes=50)
    with zipfile.ZipFile(tmp_path / "a", "w") as archive:
        for number in range(5):
            info = zipfile.ZipInfo(f"{number}.json")
            info.comment = bytes(65_535)
            info.extra = struct.pack("<2H", 0xFFFF, 65_531) + bytes(65_531)
            archive.writestr(info, "{}")
    assert unpack(tmp_path / "a", tmp_path / "out", limits).files == 5


def test_a_zip64_with_as_many_entries_as_allowed_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its directory is at another offset, and counting at the wrong one would find fewer entries."""
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 5)
    archive = zipped(tmp_path / "a", {f"{i}.json": b"{}" for i in range(50)})
    assert b"PK\x06\x06" in archive.read_bytes()
    assert unpack(archive, tmp_path / "out", LIMITS).files == 50
    shutil.rmtree(tmp_path / "out")
    assert "more than 49 entries" in refused(archive, Limits(files=49, bytes=50_000))
    content = bytearray(archive.read_bytes())
    content[content.rindex(b"PK\x06\x06") + 32] = 1  # the declared number of entries
    archive.write_bytes(content)
    with monkeypatch.context() as patch:
        patch.setattr(zipfile, "ZipFile", None)  # the entries must be counted before it is used
        assert "more than 49 entries" in refused(archive, Limits(files=49, bytes=50_000))


def test_a_name_that_is_not_utf8_is_refused_with_a_remedy(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "a", "w", format=tarfile.GNU_FORMAT, encoding="latin-1") as archive:
        archive.addfile(member("caf\u00e9.json"))
    message = refused(tmp_path / "a")
    assert "not UTF-8" in message
    message.encode()


def test_a_path_that_is_too_long_is_refused_with_a_remedy(tmp_path: Path) -> None:
    name = "/".join(["d" * 255] * 15 + ["e" * 200 + ".json"])
    assert "Use shorter names" in refused(zipped(tmp_path / "a", {name: b"{}"}))


def test_a_path_that_is_too_long_only_in_this_store_is_refused_with_a_remedy(tmp_path: Path) -> None:
    deep = tmp_path.joinpath(*["d" * 250] * 10)
    deep.mkdir(parents=True)
    name = "/".join(["e" * 250] * 7 + ["x.json"])
    assert "disk of the service" in refused(zipped(deep / "a", {name: b"{}"}))
