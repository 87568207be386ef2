"""Threads and memory of a process."""

from __future__ import annotations

import platform
import resource

import pytest
import torch

from graings.kernel import use_threads


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can keep freed memory")
@pytest.mark.parametrize("megabytes", [16, 80])
def test_freed_memory_is_kept_for_the_next_step(megabytes: int) -> None:
    use_threads(1)

    def faults(rounds: int) -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(rounds):
            torch.ones(megabytes << 18)
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    faults(20)  # warm-up
    pages = 5 * (megabytes << 20) // resource.getpagesize()
    assert faults(5) < pages / 20
