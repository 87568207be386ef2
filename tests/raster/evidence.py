"""Measured errors beside the bounds they must keep: asserted where they arise, collected for `docs/numerics.md`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

HEADER = """# Numerics of the rasterizer

Written by the tests: `GRAINGS_EVIDENCE=docs/numerics.md pytest tests/raster`. Each line is the worst of all runs of a
test, over scenes, image sizes and instruction sets. Bounds are derived, not fitted: u = 2^-24, n is the number of
Gaussians on the deepest pixel, tau(n) = (32 + 4 sqrt n) u for images in float32 outside the pixels where rounding may
tip a decision, 2e-5 norm-wise for gradients; float64 against the oracle is rounding alone.

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
    """Asserts that an error keeps its bound, and remembers under the running test's name how close it came."""
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
    """All cases so far as a table."""
    lines = [
        f"| {case} | {what} | {row.measured:.1e} | {'exact' if row.bound == 0 else f'{row.bound:.1e}'} | {row.runs} |\n"
        for (case, what), row in sorted(_rows.items())
    ]
    path.write_text(HEADER + "".join(lines))
