"""Number of CPU threads of this process.

The kernel has its own thread pool. Torch and the matrix products of numpy use one thread: each of their many small
operations would end in a barrier that may wait for a core used by another process, and sums would depend on the number
of threads.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from threadpoolctl import threadpool_limits

from graings.kernel.extension import keep_freed_memory

_threads: int | None = None


def thread_count() -> int:
    """Default number of threads of an operator: that of `set_threads`, else all usable cores."""
    return usable_cores() if _threads is None else _threads


def set_threads(count: int | None) -> None:
    """Set the default number of threads for the whole process; None: all usable cores."""
    global _threads
    if count is not None and count < 1:
        raise ValueError(f"threads must be at least 1, got {count}")
    _threads = count


def usable_cores() -> int:
    """Number of cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use_threads(count: int | None) -> int:
    """Set up this process for `count` CPU threads (None: all usable cores) and return their number."""
    torch.set_num_threads(1)
    threadpool_limits(1, user_api="blas")
    set_threads(count)
    keep_freed_memory()
    return thread_count()


@contextmanager
def computing_threads(count: int | None) -> Iterator[int]:
    """Compute with `count` CPU threads inside the context (None: all usable cores); as before after it."""
    before, torch_before = _threads, torch.get_num_threads()
    with threadpool_limits(1, user_api="blas"):
        try:
            yield use_threads(count)
        finally:
            set_threads(before)
            torch.set_num_threads(torch_before)
