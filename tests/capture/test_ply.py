"""Vertices of PLY files, and errors for invalid files."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from graings.capture.readers.ply import read_ply
from graings.errors import CaptureError

POSITION = "property float x\nproperty double y\nproperty float z\n"
COLOR = "property uchar red\nproperty uchar green\nproperty uchar blue\n"


def header(order: str, count: int, properties: str = POSITION + COLOR, rest: str = "") -> bytes:
    """A header with `count` vertices."""
    text = f"ply\nformat {order} 1.0\ncomment end of talk\nelement vertex {count}\n{properties}{rest}end_header\n"
    return text.encode()


TEXT = header("ascii", 2) + b"1 2 3 255 0 51\n\n-1e3 0.5 inf 0 0 102\n"
POSITIONS = [[1, 2, 3], [-1e3, 0.5, np.inf]]
COLORS = np.float32([[1, 0, 0.2], [0, 0, 0.4]])


def test_text_is_read() -> None:
    positions, colors = read_ply("a.ply", TEXT)
    np.testing.assert_array_equal(positions, POSITIONS)
    np.testing.assert_array_equal(colors, COLORS)


@pytest.mark.parametrize(("order", "sign"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_is_read_and_what_follows_is_not(order: str, sign: str) -> None:
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    rows = struct.pack(f"{sign}fdf3B", 1, 2, 3, 255, 0, 51) + struct.pack(f"{sign}fdf3B", -1e3, 0.5, np.inf, 0, 0, 102)
    positions, colors = read_ply("a.ply", header(order, 2, rest=faces) + rows + b"\3\0\0")
    np.testing.assert_array_equal(positions, POSITIONS)
    np.testing.assert_array_equal(colors, COLORS)


def test_lines_may_end_as_on_windows() -> None:
    np.testing.assert_array_equal(read_ply("a.ply", TEXT.replace(b"\n", b"\r\n"))[0], POSITIONS)


def test_points_without_colours_are_grey() -> None:
    positions, colors = read_ply("a.ply", header("ascii", 1, POSITION) + b"1 2 3")
    np.testing.assert_array_equal(positions, [[1, 2, 3]])
    np.testing.assert_array_equal(colors, np.full((1, 3), 0.5, dtype=np.float32))


@pytest.mark.parametrize(
    ("kind", "value", "expected"), [("ushort", "13107", 0.2), ("float", "0.2", 0.2), ("float", "7", 1.0)]
)
def test_integer_colours_are_divided_by_the_maximum_of_their_type(kind: str, value: str, expected: float) -> None:
    file = header("ascii", 1, POSITION + COLOR.replace("uchar", kind)) + f"0 0 0 {value} 0 0".encode()
    np.testing.assert_allclose(read_ply("a.ply", file)[1][0], [expected, 0, 0], rtol=1e-6)


def test_no_vertices_give_no_points() -> None:
    assert read_ply("a.ply", header("ascii", 0))[0].shape == (0, 3)


BROKEN = {
    "empty": (b"", "is no PLY file"),
    "truncated header": (TEXT[:40], "is no PLY file, or truncated"),
    "unknown format": (TEXT.replace(b"ascii", b"runes"), "line 'format runes 1.0'"),
    "no format": (TEXT.replace(b"format ascii 1.0\n", b""), "does not declare its format"),
    "faces first": (TEXT.replace(b"element vertex", b"element face 1\nelement vertex"), "does not begin with vertices"),
    "a list in a vertex": (TEXT.replace(b"uchar red", b"list uchar int red"), "vertex property 'property list"),
    "twice the same": (TEXT.replace(b"uchar green", b"uchar red"), "vertex property 'property uchar red'"),
    "no z": (TEXT.replace(b"float z", b"float w"), "without x, y and z"),
    "too many declared": (TEXT.replace(b"vertex 2", b"vertex 3"), "declares 3 vertices and contains 2"),
    "far too many declared": (TEXT.replace(b"vertex 2", b"vertex 99999999999999"), "declares 9+ vertices"),
    "a short row": (TEXT.replace(b" 102", b""), "has 5 numbers instead of 6 in vertex 1"),
    "a word": (TEXT.replace(b"102", b"red"), "a value that does not fit its type in vertex 1"),
    "a colour beyond its type": (TEXT.replace(b"102", b"256"), "a value that does not fit its type in vertex 1"),
    "a truncated binary": (header("binary_little_endian", 1) + b"\0" * 18, "declares 1 vertices"),
    "a binary that declares far too many": (header("binary_little_endian", 10**18) + b"\0" * 18, "declares 1"),
    "a colour that is not finite": (
        header("ascii", 1, POSITION + COLOR.replace("uchar", "float")) + b"0 0 0 nan 0 0",
        "colours that are not finite",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_file_is_refused_with_its_reason(name: str) -> None:
    data, message = BROKEN[name]
    with pytest.raises(CaptureError, match=rf"^a\.ply: .*{message}") as caught:
        read_ply("a.ply", data)
    assert caught.value.remedy
