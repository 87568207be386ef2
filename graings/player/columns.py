"""Tables of numbers as whole multiples of a step, in planes of bytes: what a scene file consists of.

A table has rows and columns. Each value is offset + step q with a whole number q >= 0; offset and step belong to its
column. The bytes of q stand in planes: all lowest bytes, then all second ones, and so on, each plane column by column.
Bytes of one kind compress well, and a coarse step costs nothing beyond its digits. With `delta` q is stored as the
difference to the row before it: d >= 0 as 2 d, d < 0 as -2 d - 1.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from graings.document import Document

MAX_PLANES: Final = 3


class Table(Document):
    """Where a table is and how its values are restored."""

    name: str = Field(description="What the numbers are.")
    rows: int = Field(ge=0, description="Number of rows.")
    columns: int = Field(ge=0, description="Number of columns.")
    planes: int = Field(ge=1, le=MAX_PLANES, description="Bytes of each whole number.")
    delta: bool = Field(description="Whether numbers are differences to the row before.")
    start: int = Field(ge=0, description="First byte after the header.")
    offsets: tuple[float, ...] = Field(description="Value of the number 0, for each column.")
    steps: tuple[float, ...] = Field(description="Value of one step, for each column.")

    @property
    def bytes(self) -> int:
        """Length in the uncompressed file."""
        return self.rows * self.columns * self.planes


def pack(
    name: str, values: NDArray[np.float32], steps: ArrayLike, start: int, *, delta: bool = False
) -> tuple[Table, bytes]:
    """The table of `values` [row, column] at byte `start`, rounded to `steps`, one for all columns or one for each.

    A step is enlarged where its column would need more than MAX_PLANES bytes.
    """
    rows, columns = values.shape
    exact = values.astype(np.float64)
    offsets = exact.min(0) if rows else np.zeros(columns)
    spans = exact.max(0) - offsets if rows else np.zeros(columns)
    largest = (1 << (8 * MAX_PLANES - 1)) - 1  # half of the numbers: differences have a sign
    # In float32, as readers multiply; `tiny` for columns that are constant.
    steps32 = np.maximum(np.broadcast_to(np.asarray(steps, dtype=np.float64), columns), spans / largest)
    steps32 = np.maximum(steps32, 1e-30).astype(np.float32)
    numbers = np.rint((exact - offsets) / steps32).astype(np.int64)
    if delta:
        numbers = np.diff(numbers, axis=0, prepend=0)
        numbers = np.where(numbers >= 0, 2 * numbers, -2 * numbers - 1)
    planes = max(1, (int(numbers.max(initial=0)).bit_length() + 7) // 8)
    table = Table(
        name=name,
        rows=rows,
        columns=columns,
        planes=planes,
        delta=delta,
        start=start,
        offsets=tuple(map(float, offsets.astype(np.float32))),
        steps=tuple(map(float, steps32)),
    )
    data = numbers.T.astype(np.uint32)
    return table, b"".join(((data >> (8 * plane)) & 255).astype(np.uint8).tobytes() for plane in range(planes))


def unpack(table: Table, body: bytes) -> NDArray[np.float32]:
    """The values [row, column] of `table`; `body` is the file after its header."""
    size = table.rows * table.columns
    numbers = np.zeros(size, dtype=np.int64)
    for plane in range(table.planes):
        found = np.frombuffer(body, dtype=np.uint8, count=size, offset=table.start + plane * size)
        numbers |= found.astype(np.int64) << (8 * plane)
    columns = numbers.reshape(table.columns, table.rows)
    if table.delta:
        columns = np.where(columns % 2 == 0, columns // 2, -(columns + 1) // 2).cumsum(axis=1)
    offsets, steps = np.asarray(table.offsets)[:, None], np.asarray(table.steps)[:, None]
    return (offsets + steps * columns).astype(np.float32).T
