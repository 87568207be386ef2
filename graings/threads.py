"""Threads: how many CPU threads this process computes with, and who uses them.

The kernel has its own pool. Torch keeps to one thread: its many small operations would each end in a barrier that
waits for a core which somebody else may hold, and its sums would depend on their number. Knows nothing of what is
computed.
"""

from __future__ import annotations

import torch

from graings import kernel


def use_threads(count: int | None) -> int:
    """Compute with `count` CPU threads from now on (None: all cores this process may use); returns their number."""
    torch.set_num_threads(1)
    kernel.set_threads(count)
    kernel.keep_freed_memory()
    return kernel.threads()
