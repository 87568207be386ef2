"""read_ply: the vertices of a PLY file and their colours; everything else in the file is ignored.

It is not read by a library, because a truncated file must be distinguished from a complete one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from graings.errors import CaptureError

_TYPES: Final = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_POSITION: Final = ("x", "y", "z")
_COLOR: Final = ("red", "green", "blue")
_COUNT: Final = re.compile("[0-9]{1,40}")  # Python refuses to read numbers of any length
_HEADER_END: Final = b"end_header"
_GREY: Final = 0.5


@dataclass(frozen=True, slots=True)
class _Header:
    order: str  # byte order in numpy's notation; empty: text
    count: int
    properties: tuple[tuple[str, str], ...]  # name and numpy type without byte order
    start: int  # offset of the vertices in bytes


def read_ply(name: str, data: bytes) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Positions [M, 3] and colours [M, 3] in [0, 1], grey where the file has none.

    Integer colours are divided by the maximum of their type, floating-point ones are not scaled. Raises `CaptureError`
    naming the file `name`.
    """
    header = _header(name, data)
    table = _text(name, data, header) if not header.order else _binary(name, data, header)
    positions = np.stack([table[key].astype(np.float64) for key in _POSITION], axis=1)
    if not set(_COLOR) <= set(table.dtype.names or ()):
        return positions, np.full((header.count, 3), _GREY, dtype=np.float32)
    channels = []
    for key in _COLOR:
        kind = table.dtype[key]
        scale = float(np.iinfo(kind).max) if np.issubdtype(kind, np.integer) else 1.0
        channels.append(table[key].astype(np.float64) / scale)
    colors = np.stack(channels, axis=1)
    if not np.isfinite(colors).all():
        _fail(name, "has colours that are not finite")
    return positions, np.clip(colors, 0.0, 1.0).astype(np.float32)


def _header(name: str, data: bytes) -> _Header:
    end = data.find(_HEADER_END)
    if not data.startswith(b"ply") or end < 0:
        _fail(name, "is no PLY file, or truncated in its header")
    line_end = data.find(b"\n", end)
    if line_end < 0:
        line_end = len(data) - 1
    order: str | None = None
    elements: list[tuple[str, int]] = []
    properties: list[tuple[str, str]] = []
    for line in data[:end].decode("ascii", errors="replace").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in _ORDERS:
            order = _ORDERS[words[1]]
        elif words[0] == "element" and len(words) == 3 and _COUNT.fullmatch(words[2]):
            elements.append((words[1], int(words[2])))
        elif words[0] == "property" and elements:
            if elements[-1][0] != "vertex":
                continue
            if len(words) != 3 or words[1] not in _TYPES or words[2] in dict(properties):
                _fail(name, f"has the vertex property {line.strip()!r}, which is not read")
            properties.append((words[2], _TYPES[words[1]]))
        else:
            _fail(name, f"has the line {line.strip()!r} in its header, which is not read")
    if order is None:
        _fail(name, "does not declare its format")
    if not elements or elements[0][0] != "vertex":
        _fail(name, "does not begin with vertices")
    if not set(_POSITION) <= set(dict(properties)):
        _fail(name, "has vertices without x, y and z")
    return _Header(order, elements[0][1], tuple(properties), line_end + 1)


def _binary(name: str, data: bytes, header: _Header) -> NDArray[np.void]:
    kind = np.dtype([(key, header.order + base) for key, base in header.properties])
    if header.start + header.count * kind.itemsize > len(data):
        _fail(name, f"is truncated: it declares {header.count} vertices and contains fewer")
    return np.frombuffer(data, dtype=kind, count=header.count, offset=header.start)


def _text(name: str, data: bytes, header: _Header) -> NDArray[np.void]:
    lines = data[header.start :].decode("ascii", errors="replace").splitlines()
    rows = [line.split() for line in lines if line.strip()][: header.count]
    if len(rows) < header.count:
        _fail(name, f"is truncated: it declares {header.count} vertices and contains {len(rows)}")
    table = np.empty(header.count, dtype=np.dtype(list(header.properties)))
    for number, row in enumerate(rows):
        if len(row) != len(header.properties):
            _fail(name, f"has {len(row)} numbers instead of {len(header.properties)} in vertex {number}")
        try:
            table[number] = tuple(
                float(word) if base.startswith("f") else int(word)
                for word, (_, base) in zip(row, header.properties, strict=True)
            )
        except (ValueError, OverflowError):
            _fail(name, f"has a value that does not fit its type in vertex {number}")
    return table


def _fail(name: str, problem: str) -> NoReturn:
    raise CaptureError(problem, file=name, remedy="Export the points again, or remove ply_file_path.")
