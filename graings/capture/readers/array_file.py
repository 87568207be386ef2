"""read_array: a table of numbers in NumPy's file format.

Not by `numpy.load`, which allocates what the header declares before it looks whether that much follows.
"""

from __future__ import annotations

import io
import tokenize
from typing import Any, NoReturn

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from graings.capture.folder import CaptureFolder
from graings.errors import CaptureError


def read_array(folder: CaptureFolder, name: str, *, columns: int) -> NDArray[np.float64]:
    """The table [N, `columns`] in the file `name`, without Python objects. Raises `CaptureError` for anything else."""
    data = folder.read(name)
    file = io.BytesIO(data)
    try:
        shape, by_column, dtype = _header(file)
    except (ValueError, TypeError, SyntaxError, tokenize.TokenError, ArithmeticError, RecursionError) as error:
        _fail(name, f"is no array ({error})")
    if [type(size) for size in shape] != [int, int] or shape[1] != columns or shape[0] < 1:  # True is an int, too
        _fail(name, f"holds {shape}, not (N, {columns}) numbers", "shape")
    if dtype.kind not in "fiu":
        _fail(name, f"holds {dtype}", "dtype")
    count, start = shape[0] * columns, file.tell()
    if count * dtype.itemsize > len(data) - start:
        _fail(name, f"is truncated: it declares {shape[0]} rows and contains fewer")
    values = np.frombuffer(data, dtype, count, start)
    return values.reshape(shape, order="F" if by_column else "C").astype(np.float64)


def _header(file: io.BytesIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether columns follow each other, and type. Raises whatever NumPy does."""
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0)):  # the third is for structures with names that are not ASCII
        raise ValueError(f"version {version}")
    return npy.read_array_header_1_0(file) if version == (1, 0) else npy.read_array_header_2_0(file)


def _fail(name: str, problem: str, field: str | None = None) -> NoReturn:
    raise CaptureError(problem, file=name, field=field, remedy="Export the capture again.")
