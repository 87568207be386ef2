"""Writes the evidence of a session where GRAINGS_EVIDENCE names a file."""

from __future__ import annotations

import ctypes
import os
import platform
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.raster import evidence


def pytest_sessionfinish() -> None:
    if "GRAINGS_EVIDENCE" in os.environ:
        evidence.write(Path(os.environ["GRAINGS_EVIDENCE"]))


@pytest.fixture
def dirty_memory() -> Iterator[None]:
    """Memory comes filled with 0xFF: not a number as float or double, -1 as an integer."""
    if platform.libc_ver()[0] != "glibc":
        pytest.skip("only glibc fills what it hands out")
    mallopt = ctypes.CDLL(None).mallopt
    perturb = -6
    # glibc writes the complement of the lowest byte, and nothing where the whole number is 0
    assert mallopt(perturb, 0x100) == 1
    yield
    mallopt(perturb, 0)
