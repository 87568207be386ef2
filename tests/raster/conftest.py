"""Writes the measured errors of a test session to the file named by GRAINGS_EVIDENCE."""

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
    """Fills newly allocated memory with 0xFF: NaN as float or double, -1 as an integer."""
    if platform.libc_ver()[0] != "glibc":
        pytest.skip("only glibc can fill allocated memory")
    mallopt = ctypes.CDLL(None).mallopt
    perturb = -6
    # glibc writes the complement of the lowest byte, and nothing where the whole number is 0
    assert mallopt(perturb, 0x100) == 1
    yield
    mallopt(perturb, 0)
