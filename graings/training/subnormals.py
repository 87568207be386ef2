"""Subnormal numbers of float32, below 1.2e-38 in magnitude: operations on them take some CPUs 150 cycles."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


def subnormals_are_flushed() -> bool:
    """Whether torch's operations on this thread replace subnormal numbers by zero."""
    return not bool(torch.full((1,), 2.0**-126).mul(0.5).mul(2.0).any())


@contextmanager
def flushed_subnormals() -> Iterator[None]:
    """Torch's operations on this thread replace subnormal numbers by zero, where the CPU can; as before after it."""
    before = subnormals_are_flushed()
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)
