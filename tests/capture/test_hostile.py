"""Files of strangers: whatever is in them is read or refused by a clear error, without much memory."""

from __future__ import annotations

import io
import json
import os
import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from graings.capture.folder import CaptureFolder
from graings.capture.image_file import PNG_SIGNATURE, check_image
from graings.capture.load import load_capture
from graings.capture.readers.array_file import read_array
from graings.capture.readers.ply import read_ply
from graings.errors import MAX_MESSAGE, CaptureError, CheckpointError, printable
from graings.footage.photos import convert_photographs
from tests.capture.captures import write_colmap, write_dnerf, write_image
from tests.capture.test_nerfies import write_nerfies

EXAMPLES = settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])

# Values that fit no field, and those that fit many and are impossible.
STRANGE = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**400), 10**400),
    st.floats(),
    st.text(max_size=30),
    st.sampled_from(("../../x", "/etc/passwd", "a\0b", "\udcff", "x" * 3_000, "\x1b[2J")),
    st.lists(st.integers(), max_size=3),
    st.dictionaries(st.text(max_size=3), st.none(), max_size=2),
)


def npy(header: str, body: bytes = b"", version: int = 1) -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", len(text)) + text + body


def refused(folder: Path, content: bytes) -> str:
    """The message with which an array is refused, for which next to no memory may be taken."""
    (folder / "a.npy").write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(CaptureError, match=r"a\.npy") as caught:
            read_array(CaptureFolder(folder), "a.npy", columns=3)
        assert tracemalloc.get_traced_memory()[1] < 2 << 20
    finally:
        tracemalloc.stop()
    return str(caught.value)


@pytest.mark.parametrize("rows", [3, 2**20, 2**33, 2**64, -1])
@pytest.mark.parametrize("dtype", ["<f8", ">f4", "<i8", "|u1", "<c16", "|O", "<U4294967", "|S17", "|V300", "<M8[s]"])
def test_an_array_that_declares_more_than_it_holds_is_refused(tmp_path: Path, rows: int, dtype: str) -> None:
    for order in (False, True):
        header = f"{{'descr': {dtype!r}, 'fortran_order': {order}, 'shape': ({rows}, 3)}}"
        assert "a.npy" in refused(tmp_path, npy(header, bytes(2)))


@pytest.mark.parametrize(
    "header",
    ["", "(" * 300, "((", "{", "{'descr': '<f8'}", "x" * 20_000, "{'descr': [], 'fortran_order': False, 'shape': ()}"]
    + [
        f"{{'descr': '<f8', 'fortran_order': False, 'shape': {s}}}"
        for s in ("3", "(3,)", "(1.5, 3)", "(True, 3)", "('a', 3)", "(0, 3)")
    ]
    + [f"{{'descr': {d}, 'fortran_order': False, 'shape': (1, 3)}}" for d in ("3", "None", "('<f8', -1)", "'\\0'")],
)
def test_a_header_of_an_array_that_is_none_is_refused(tmp_path: Path, header: str) -> None:
    refused(tmp_path, npy(header, bytes(100)))
    refused(tmp_path, npy(header, bytes(100), version=2))


def test_arrays_of_every_number_and_order_are_read(tmp_path: Path) -> None:
    for dtype in ("<f4", ">f8", "<i2", "|u1"):
        for order in ("C", "F"):
            values = np.array(np.arange(6).reshape(2, 3), dtype=dtype, order=order)  # type: ignore[call-overload]
            np.save(tmp_path / "a.npy", values)
            np.testing.assert_array_equal(read_array(CaptureFolder(tmp_path), "a.npy", columns=3), values)


@EXAMPLES
@given(st.binary(max_size=60), st.integers(0, 200))
def test_any_damage_to_an_array_is_refused_or_harmless(tmp_path: Path, patch: bytes, place: int) -> None:
    target = io.BytesIO()
    np.save(target, np.zeros((2, 3)))
    whole = target.getvalue()
    (tmp_path / "a.npy").write_bytes(whole[:place] + patch + whole[place + len(patch) :])
    try:
        assert read_array(CaptureFolder(tmp_path), "a.npy", columns=3).shape[1] == 3
    except CaptureError as error:
        assert str(error).isprintable()  # noqa: PT017


def places(value: Any) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    for key, child in value.items() if isinstance(value, dict) else enumerate(value):
        found.append((value, key))
        if isinstance(child, dict | list):
            found += places(child)
    return found


@EXAMPLES
@given(st.data())
def test_any_value_in_a_transforms_file_is_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    if not (tmp_path / "transforms_train.json").exists():
        write_dnerf(tmp_path, [0.0, 0.5, 1.0])
        (tmp_path / "seed.json").write_bytes((tmp_path / "transforms_train.json").read_bytes())
    document = json.loads((tmp_path / "seed.json").read_text())
    parent, key = data.draw(st.sampled_from(places(document)))
    parent[key] = data.draw(STRANGE)
    (tmp_path / "transforms_train.json").write_text(json.dumps(document))
    try:
        load_capture(tmp_path)
    except CaptureError as error:
        message = str(error).replace(f"{tmp_path}", "")
        assert message.isprintable()
        assert len(message) < 2 * MAX_MESSAGE


@pytest.mark.parametrize("number", ["9" * 4_000, "18446744073709551615", "\u00b2", "\u0663", "-1", "1e400"])
def test_numbers_of_any_length_are_refused_where_they_count(tmp_path: Path, number: str) -> None:
    """Python converts none with more than 4300 digits, and none above 1e308 to a float."""
    sparse = write_colmap(tmp_path / "a", text=True) / "sparse/0"
    cameras, points = (sparse / "cameras.txt").read_text(), (sparse / "points3D.txt").read_text()
    (sparse / "cameras.txt").write_text(cameras.replace(" 32 20 ", f" {number} {number} "))
    with pytest.raises(CaptureError, match="camera"):
        load_capture(tmp_path / "a")
    (sparse / "cameras.txt").write_text(cameras)
    (sparse / "points3D.txt").write_text(f"# Number of points: {number}\n{points}", encoding="utf-8")
    try:
        load_capture(tmp_path / "a")
    except CaptureError as error:
        assert "points3D" in str(error)  # noqa: PT017


@pytest.mark.parametrize("key", ["warp_id", "time_id", "image_size", "focal_length", "position", "radial_distortion"])
@pytest.mark.parametrize("number", [10**400, -(10**400), 2**64, 1e308, -1e308, 1e-308, 0])
def test_numbers_of_a_nerfies_capture_are_read_or_refused(tmp_path: Path, key: str, number: float) -> None:
    write_nerfies(tmp_path)
    for file in (tmp_path / "metadata.json", *(tmp_path / "camera").iterdir()):
        document = json.loads(file.read_text())
        for entry in document.values() if file.name == "metadata.json" else [document]:
            if key in entry:
                entry[key] = [number] * len(entry[key]) if isinstance(entry[key], list) else number
            elif key == "time_id" and "warp_id" in entry:
                entry[key] = number
        file.write_text(json.dumps(document))
    try:
        load_capture(tmp_path)
    except CaptureError as error:
        assert str(error).isprintable()  # noqa: PT017


def test_names_that_do_not_print_are_shown_by_number(tmp_path: Path) -> None:
    """Otherwise the command line, whose output is UTF-8, would end with a stack trace, and a terminal obey the file."""
    write_colmap(tmp_path, text=True)
    file = tmp_path / "sparse/0/images.txt"
    for number in range(0, 50, 10):  # more images than may be missing
        file.write_bytes(file.read_bytes().replace(b"frame_%04d" % number, b"fr\xff\x1b[2J\xe2\x80\xae%d" % number))
    with pytest.raises(CaptureError) as caught:
        load_capture(tmp_path)
    assert "\\udcff\\x1b[2J\\u202e" in str(caught.value)
    assert str(caught.value).isprintable()


def test_notes_print_too(tmp_path: Path) -> None:
    write_colmap(tmp_path, text=True)
    file = tmp_path / "sparse/0/images.txt"
    file.write_bytes(file.read_bytes().replace(b"frame_0010", b"fr\xff\x1b"))
    (tmp_path / "images/frame_0010.png").rename(tmp_path / "images/other.png")
    notes = load_capture(tmp_path).notes
    assert any("\\udcff\\x1b" in note for note in notes)
    assert all(note.isprintable() for note in notes)


def test_names_and_folders_of_another_encoding_are_refused(tmp_path: Path) -> None:
    latin = os.fsdecode(b"caf\xe9")
    write_dnerf(tmp_path / "cafe/scene")
    try:
        (tmp_path / "cafe").rename(tmp_path / latin)
    except OSError:
        pytest.skip("the file system has no such names")
    with pytest.raises(CaptureError, match=r"caf\\udce9/scene: its path is not UTF-8.*Rename"):
        load_capture(tmp_path / latin / "scene")
    folder = tmp_path / "colmap"
    write_colmap(folder, text=True)
    file = folder / "sparse/0/images.txt"
    file.write_bytes(file.read_bytes().replace(b"frame_0010", b"caf\xe9"))
    (folder / "images/frame_0010.png").rename(folder / "images" / f"{latin}.png")
    with pytest.raises(CaptureError, match=r"caf\\udce9\.png: has a name that is not UTF-8.*Rename"):
        load_capture(folder)


@given(st.text(alphabet=st.characters(), max_size=5_000))
def test_messages_print_and_end(text: str) -> None:
    for error in (CaptureError(text, file=text, field=text, remedy="Send another."), CheckpointError(text)):
        assert str(error).replace("\n", "").isprintable()
        assert len(str(error)) <= MAX_MESSAGE + 3
    assert str(CaptureError(text, file="a", remedy="Send another.")).endswith("Send another.")
    assert printable("Größe 4\n日本") == "Größe 4\n日本"


@pytest.mark.parametrize("word", ["9" * 5_000, "1_000", "\u0663", "-1", "1e3", "x" * 90_000, "18446744073709551616"])
@pytest.mark.parametrize("place", [b"vertex 1", b"float x", b"ascii"])
def test_a_word_in_the_header_of_a_ply_is_refused_briefly(word: str, place: bytes) -> None:
    head = b"ply\nformat ascii 1.0\nelement vertex 1\n" + b"".join(b"property float %c\n" % axis for axis in b"xyz")
    content = (head + b"end_header\n1 2 3\n").replace(place, place.split()[0] + b" " + word.encode())
    with pytest.raises(CaptureError) as caught:
        read_ply("p.ply", content)
    assert len(str(caught.value)) < MAX_MESSAGE + 100


def png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">2I5B", width, height, 8, 6, 0, 0, 0)
    return PNG_SIGNATURE + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(100_000, 100_000), (8_193, 8_193), (16_385, 1), (2**31 - 1, 2**31 - 1)])
def test_images_of_any_declared_size_are_refused_before_they_are_decoded(tmp_path: Path, size: tuple[int, int]) -> None:
    photo = tmp_path / "a.png"
    photo.write_bytes(png(*size))
    with pytest.raises(CaptureError, match=r"a\.png"):
        check_image(photo, "a.png", photo.read_bytes())
    with pytest.raises(CaptureError, match=r"a\.png"):
        convert_photographs([photo], tmp_path, 32, lambda done, count: None)


def test_an_image_whose_header_is_no_text_is_refused(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.exr", np.zeros((8, 8, 3), np.float32), "half")
    whole, refusals = path.read_bytes(), 0
    for place in range(8, 300):
        path.write_bytes(whole[:place] + b"\xff\xfe" + whole[place + 2 :])
        try:
            check_image(path, "a.exr", path.read_bytes())
        except CaptureError as error:
            refusals += 1
            assert str(error).isprintable()  # noqa: PT017
    assert refusals > 100


def test_a_photograph_with_values_that_are_not_finite_is_refused(tmp_path: Path) -> None:
    pixels = np.full((8, 8, 3), 0.5, np.float32)
    pixels[2, 3] = np.nan
    photo = write_image(tmp_path / "a.tif", pixels, "float")
    with pytest.raises(CaptureError, match="not finite"):
        convert_photographs([photo], tmp_path, 32, lambda done, count: None)
