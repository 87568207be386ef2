"""Measured errors and their bounds: asserted in the tests, collected for `docs/numerics.md`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

HEADER = """# Numerics of the rasterizer

Written by the tests: `GRAINGS_EVIDENCE=docs/numerics.md pytest tests/raster`. Each line is the worst case
of a test, over scenes, image sizes and instruction sets. The oracle is the slow reference,
`graings/raster/reference.py`. Bounds are derived, not fitted. With u = 2^-24 and n the largest number of Gaussians
blended into a pixel, images in float32 may differ by (32 + 4 sqrt n) u, except at pixels where rounding may reverse a
threshold decision; gradients by 2e-5 of their norm. Differences of the float64 kernel to the oracle are rounding.

| test | what | measured | bound | runs |
|---|---|---|---|---|
"""


@dataclass(slots=True)
class Row:
    """The worst measurement of a case so far."""

    measured: float
    bound: float
    runs: int


_rows: dict[tuple[str, str], Row] = {}


def within(what: str, measured: float, bound: float) -> None:
    """Asserts that an error is within its bound, and records it under the name of the running test."""
    case = (
        os.environ["PYTEST_CURRENT_TEST"]
        .split("::")[-1]
        .split("[")[0]
        .split(" ")[0]
        .removeprefix("test_")
        .replace("_", " ")
    )
    row = _rows.setdefault((case, what), Row(measured, bound, 0))
    row.runs += 1
    if measured * max(row.bound, 1e-300) >= row.measured * max(bound, 1e-300):
        row.measured, row.bound = measured, bound
    assert measured <= bound, f"{case}: {what} is {measured:.3e}, more than {bound:.3e}"


def write(path: Path) -> None:
    """Writes all recorded cases as a table."""
    lines = [
        f"| {case} | {what} | {row.measured:.1e} | {'exact' if row.bound == 0 else f'{row.bound:.1e}'} | {row.runs} |\n"
        for (case, what), row in sorted(_rows.items())
    ]
    path.write_text(HEADER + "".join(lines))
