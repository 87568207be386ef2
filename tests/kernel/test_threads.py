"""Threads and memory of a process."""

from __future__ import annotations

import platform
import resource
import subprocess
import sys

import pytest

BLAS = """
import numpy, torch
from threadpoolctl import threadpool_info
from graings.kernel import computing_threads, set_threads, thread_count, use_threads
def threads():
    return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
before = threads()
set_threads(3)
with computing_threads(2) as count:
    print(count, max(threads(), default=1), torch.get_num_threads())
print(thread_count(), threads() == before)
use_threads(2)
print(thread_count(), max(threads(), default=1), torch.get_num_threads())
"""


def test_torch_and_blas_use_one_thread_and_get_theirs_back() -> None:
    done = subprocess.run([sys.executable, "-c", BLAS], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["2 1 1", "3 True", "2 1 1"]


FAULTS = """
import resource, sys, torch
from graings.kernel import use_threads
use_threads(1)
def faults(rounds):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(rounds):
        torch.ones(int(sys.argv[1]) << 18)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults(20)  # warm-up
print(faults(5))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can keep freed memory")
@pytest.mark.parametrize("megabytes", [16, 80])
def test_freed_memory_is_kept_for_the_next_step(megabytes: int) -> None:
    # In a process of its own: above a gigabyte of free memory, which other tests may leave, the rest is returned.
    done = subprocess.run([sys.executable, "-c", FAULTS, str(megabytes)], capture_output=True, text=True, check=True)
    pages = 5 * (megabytes << 20) // resource.getpagesize()
    assert int(done.stdout) < pages / 20
