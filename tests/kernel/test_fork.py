"""The kernel in a child of fork(), which has none of the threads of the pool."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

CHILD = """
import os, sys, threading, torch
from graings.kernel import use_threads
from graings.scene.activations import tanh

use_threads(4)
values = torch.linspace(-3, 3, 300_000)
expected = tanh(values)
busy = sys.argv[1] == "busy"
stop = threading.Event()

def work():
    while not stop.is_set():
        tanh(values)

threads = [threading.Thread(target=work) for _ in range(2 if busy else 0)]
for thread in threads:
    thread.start()
usable = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
failed = 0
for _ in range(10):
    child = os.fork()
    if child == 0:
        for other in [threading.Thread(target=int) for _ in range(64)]:
            other.start()
            other.join()
        same = all(torch.equal(tanh(values), expected) for _ in range(20))
        free = usable is None or os.sched_getaffinity(0) == usable
        os._exit(0 if same and free else 3)
    failed += os.waitpid(child, 0)[1] != 0
stop.set()
for thread in threads:
    thread.join()
assert torch.equal(tanh(values), expected)
print("failed", failed)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork()")
@pytest.mark.parametrize("parent", ["idle", "busy"])
def test_a_child_computes_with_all_cores(parent: str) -> None:
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", CHILD, parent]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == "failed 0"
