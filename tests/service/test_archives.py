"""What strangers may send. Each archive is really built, and really refused."""

from __future__ import annotations

import gzip
import io
import os
import shutil
import struct
import tarfile
import tracemalloc
import zipfile
from collections.abc import Callable
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
    """The message with which an archive is refused; nothing may be left of it, inside or outside of its folder."""
    before = sorted(archive.parent.rglob("*"))
    with pytest.raises(ArchiveError) as caught:
        unpack(archive, archive.parent / "out", limits)
    assert sorted(archive.parent.rglob("*")) == before
    return str(caught.value)


@pytest.mark.parametrize("mode", ["zip", "w:gz"])
def test_any_damaged_byte_is_refused_or_harmless(tmp_path: Path, mode: str) -> None:
    """One error class of a library that nobody thought of would be a failure of the service."""
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
def test_a_capture_comes_out_as_it_went_in(tmp_path: Path, mode: str) -> None:
    files = {"scene/transforms_train.json": b"{}", "scene/train/r_0.png": os.urandom(3_000)}
    if mode == "zip":
        archive = zipped(tmp_path / "a", files, compression=zipfile.ZIP_DEFLATED)
    else:
        archive = tarred(tmp_path / "a", *((member(name), content) for name, content in files.items()), mode=mode)
    found = unpack(archive, tmp_path / "out", LIMITS)
    assert (found.files, found.bytes, found.skipped) == (2, 3_002, 0)
    assert {str(p.relative_to(tmp_path / "out")): p.read_bytes() for p in (tmp_path / "out").rglob("*.*")} == files


def test_files_that_no_capture_has_are_left_out(tmp_path: Path) -> None:
    files = {"a.json": b"{}", "run.sh": b"#!", "__MACOSX/a.json": b"x", ".git/b.json": b"x", "noending": b"x"}
    found = unpack(zipped(tmp_path / "a", files), tmp_path / "out", LIMITS)
    assert (found.files, found.skipped) == (1, 4)
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


def test_a_zip_that_lies_about_sizes_is_refused(tmp_path: Path) -> None:
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


def test_what_is_no_archive_or_holds_nothing_is_refused(tmp_path: Path) -> None:
    for content, word in (
        (b"", "no archive"),
        (b"hello", "no archive"),
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


@pytest.mark.parametrize(
    "kind", [tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK, tarfile.XHDTYPE, tarfile.XGLTYPE], ids=str
)
def test_a_name_of_many_megabytes_is_refused_before_it_is_read(tmp_path: Path, kind: bytes) -> None:
    size = 64 << 20
    info = member("long", kind)
    info.size = size
    with gzip.open(tmp_path / "bomb.tar.gz", "wb", compresslevel=1) as file:
        file.write(info.tobuf(tarfile.GNU_FORMAT))
        file.write(bytes(size))
    (most, message) = peak_of(lambda: refused(tmp_path / "bomb.tar.gz"))
    assert "headers of more than" in message
    assert most < 4 << 20


def test_many_long_names_before_one_entry_are_refused(tmp_path: Path) -> None:
    with gzip.open(tmp_path / "bomb.tar.gz", "wb") as file:
        for _ in range(100):
            info = member("long", tarfile.GNUTYPE_LONGNAME)
            info.size = 1024
            file.write(info.tobuf(tarfile.GNU_FORMAT) + 1024 * b"a")
    assert "headers of more than" in refused(tmp_path / "bomb.tar.gz")


def test_a_sparse_file_is_refused(tmp_path: Path) -> None:
    refusal = refused(tarred(tmp_path / "a.tar", (member("train/a.png", tarfile.GNUTYPE_SPARSE), b"")))
    assert "--sparse" in refusal


def test_a_zip_of_a_hundred_thousand_entries_is_refused_before_its_list_is_read(tmp_path: Path) -> None:
    # One entry over and over, as zipfile takes a second to write so many.
    archive = zipped(tmp_path / "a.zip", {"a.png": b""})
    content = archive.read_bytes()
    first, end = content.index(b"PK\1\2"), content.index(b"PK\5\6")
    many, entry = 100_000, content[first:end]
    directory = many * entry
    closing = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 1, 1, len(directory), first, 0)
    archive.write_bytes(content[:first] + directory + closing)  # and it says that there is one
    most, message = peak_of(lambda: refused(archive))
    assert "list of entries" in message
    assert most < 1 << 20


def test_a_zip_that_hides_how_many_entries_it_has_is_refused(tmp_path: Path) -> None:
    archive = zipped(tmp_path / "a.zip", {f"{i}.png": b"" for i in range(LIMITS.files + 1)})
    content = bytearray(archive.read_bytes())
    end = content.index(b"PK\5\6")
    content[end + 8 : end + 12] = struct.pack("<2H", 1, 1)
    archive.write_bytes(content)
    assert f"more than {LIMITS.files} entries" in refused(archive)


def test_a_name_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "a.tar", "w", format=tarfile.GNU_FORMAT, encoding="latin-1") as archive:
        archive.addfile(member("\xe9a/transforms_train.json"))
    assert "UTF-8" in refused(tmp_path / "a.tar")


def test_a_path_longer_than_a_disk_takes_is_refused(tmp_path: Path) -> None:
    path = "/".join([*(15 * [255 * "a"]), 205 * "b"])
    assert "too long" in refused(tarred(tmp_path / "a.tar", (member(path + ".png"), b"x")))


def peak_of(call: Callable[[], str]) -> tuple[int, str]:
    """Most bytes that Python held during a call, and what it gave."""
    tracemalloc.start()
    try:
        given = call()
        return tracemalloc.get_traced_memory()[1], given
    finally:
        tracemalloc.stop()
