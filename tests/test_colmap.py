from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("pycolmap")

PROGRAM = """
import os, signal, time
signal.signal(signal.SIGTERM, lambda *_: print("asked to stop", flush=True))
from graings.colmap import import_pycolmap
for _ in range(2):
    import_pycolmap().SiftExtractionOptions()
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.05)
"""


def test_a_process_that_uses_pycolmap_still_receives_sigterm() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "asked to stop\n" * 2, "")
