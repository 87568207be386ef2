"""What a process is set up with before it computes."""

from __future__ import annotations

import platform
import resource

import pytest
import torch

from graings.kernel import use_threads


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told to keep memory")
@pytest.mark.parametrize("megabytes", [16, 80])
def test_memory_that_a_step_frees_is_there_for_the_next(megabytes: int) -> None:
    use_threads(1)

    def faults(rounds: int) -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(rounds):
            torch.ones(megabytes << 18)
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    faults(20)  # until small things lie where they do not matter
    pages = 5 * (megabytes << 20) // resource.getpagesize()
    assert faults(5) < pages / 20
