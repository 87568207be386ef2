"""Runs the rasterizer's tests on a kernel built with a sanitizer, and prints its findings.

    python benchmarks/sanitize.py address | undefined | thread [pytest's arguments]

Works in a copy of the package in a temporary folder. Without further arguments `address` and `undefined` run
tests/raster, `thread` those of its tests that use several threads. The exit code is 1 if a test fails or the sanitizer
reports a finding.

A few tests cannot pass under `address`: those in which glibc fills memory with 0xFF, because the sanitizer has its own
allocator, and one of peak memory, which the sanitizer's bookkeeping exceeds. Needs GCC, CMake and nanobind.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from working_copy import WorkingCopy

ROOT = Path(__file__).resolve().parent.parent
LIBRARIES = {"address": "libasan.so", "undefined": "libubsan.so", "thread": "libtsan.so"}
TESTS = {
    "address": ["tests/raster"],
    "undefined": ["tests/raster"],
    "thread": ["tests/raster", "-k", "thread or crowd or neighbour or sorted or retained"],
}


def preloaded(kind: str) -> str:
    """Libraries to preload: the sanitizer, and libstdc++, whose exceptions it intercepts."""
    paths = []
    for name in (LIBRARIES[kind], "libstdc++.so.6"):
        found = subprocess.run(["g++", f"-print-file-name={name}"], capture_output=True, text=True, check=True)
        paths.append(found.stdout.strip())
    return " ".join(paths)


def environment(kind: str, findings: Path) -> dict[str, str]:
    """Environment of the tests: findings go to files named `findings`.PID, because pytest captures other output."""
    settings = {
        "address": "detect_leaks=0",  # the interpreter does not free all memory at exit
        "undefined": "print_stacktrace=1:halt_on_error=1",
        "thread": "halt_on_error=1:ignore_noninstrumented_modules=1",
    }
    name = {"address": "ASAN_OPTIONS", "undefined": "UBSAN_OPTIONS", "thread": "TSAN_OPTIONS"}[kind]
    # OpenMP of torch is not built with the sanitizer, which would report its threads as races.
    return {name: f"{settings[kind]}:log_path={findings}", "LD_PRELOAD": preloaded(kind), "OMP_NUM_THREADS": "1"}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=LIBRARIES)
    options, arguments = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        copy = WorkingCopy(ROOT, folder, os.cpu_count() or 1, f"-DGRAINGS_SANITIZE={options.kind}")
        copy.build()
        tests = arguments or TESTS[options.kind]
        ran = copy.pytest("-q", "-m", "not slow", *tests, environment=environment(options.kind, folder / "finding"))
        print(ran.stdout, ran.stderr, sep="\n", end="")
        found = sorted(folder.glob("finding*"))
        for path in found:
            print(path.read_text(encoding="utf-8", errors="replace")[:20_000])
    print(f"{options.kind}: {len(found)} findings, pytest ended with {ran.returncode}")
    return 1 if found or ran.returncode != 0 else 0


if __name__ == "__main__":
    sys.exit(main())
