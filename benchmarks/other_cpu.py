"""Runs the kernel on an emulated CPU and compares its results with those of this CPU.

    python benchmarks/other_cpu.py [--compiler aarch64-linux-gnu-g++] [--emulator qemu-aarch64]

Compiles the kernel's sources with other_cpu.cpp, which needs no interpreter, once for this CPU and once with
`compiler`, and runs the latter with `emulator` (Debian: g++-aarch64-linux-gnu, qemu-user). Inputs are
generated from the same integers on both. Prints for every array the largest difference from this CPU's float64 results,
relative to the array's largest number, for the other CPU and for each instruction set here. The exit code is 1 if the
other CPU differs by more than ten times the worst instruction set here, and in float64 also by more than 1e-12: sums
without fused products differ by 4e-14.

It does not measure speed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graings import kernel

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "graings/kernel/csrc"
FLAGS = [
    "-std=gnu++20",
    "-O3",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-w",
    "-pthread",
    "-static",
]
LIMIT = 1e-12  # of float64
# Compiled once for each instruction set, for Python, and for AMX.
ELSEWHERE = ("kernels.cpp", "bindings.cpp", "prepared_bindings.cpp", "bfloat16.cpp")
Arrays = dict[str, NDArray[np.float64]]


def build(compiler: str, folder: Path) -> Path:
    """The program for the compiler's CPU, with all of the kernel's instruction sets for it."""
    machine = subprocess.run([compiler, "-dumpmachine"], capture_output=True, text=True, check=True).stdout
    sets: dict[str, list[str]] = {"generic": []}
    if machine.startswith("x86_64"):
        sets["avx2"] = ["-mavx2", "-mfma", "-mpopcnt", "-mbmi"]
        features = ("avx512f", "avx512dq", "avx512bw", "avx512vl", "fma", "popcnt", "bmi", "prefer-vector-width=512")
        sets["avx512"] = [f"-m{feature}" for feature in features]
    define = ["-DGRAINGS_X86"] if len(sets) > 1 else []
    objects = []
    for name, flags in sets.items():
        objects.append(folder / f"{name}.o")
        compile_one = [compiler, *FLAGS, *flags, f"-DGRAINGS_ISA={name}", "-c", str(SOURCES / "kernels.cpp")]
        subprocess.run([*compile_one, "-o", str(objects[-1])], check=True)
    program = folder / "program"
    subprocess.run([compiler, *FLAGS, *define, *sources(), *map(str, objects), "-o", str(program)], check=True)
    return program


def sources() -> list[str]:
    """What is compiled once for all instruction sets, and where its headers are."""
    kernels = [str(path) for path in sorted(SOURCES.glob("*.cpp")) if path.name not in ELSEWHERE]
    return [f"-I{SOURCES}", str(Path(__file__).with_suffix(".cpp")), *kernels]


def output(*command: str, isa: str) -> Arrays:
    """The arrays written by the program, run with the instruction set `isa`."""
    written = subprocess.run(command, env=os.environ | {"GRAINGS_ISA": isa}, capture_output=True, check=True).stdout
    arrays: Arrays = {}
    while written:
        line, _, written = written.partition(b"\n")
        name, count = line.decode().split()
        arrays[name] = np.frombuffer(written[: 8 * int(count)])
        written = written[8 * int(count) :]
    return arrays


def distance(array: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """The largest difference relative to the largest number; infinite if it is not finite."""
    apart = float(np.abs(array - truth).max() / np.abs(truth).max())
    return apart if np.isfinite(apart) else float("inf")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--compiler", default="aarch64-linux-gnu-g++")
    parser.add_argument("--emulator", default="qemu-aarch64")
    options = parser.parse_args()
    for tool in ("g++", options.compiler, options.emulator):
        if shutil.which(tool) is None:
            raise SystemExit(f"{tool} is not installed (Debian: apt-get install g++-aarch64-linux-gnu qemu-user)")
    with tempfile.TemporaryDirectory() as name:
        here, there = Path(name) / "here", Path(name) / "there"
        here.mkdir()
        there.mkdir()
        native, foreign = build("g++", here), build(options.compiler, there)
        ours = {isa: output(str(native), isa=isa) for isa in kernel.available_isas()}
        theirs = output(options.emulator, str(foreign), isa="generic")
    columns = {"there": theirs, **ours}
    first = next(iter(ours.values()))
    print(f"{'array':<24}" + "".join(f"{column:>10}" for column in columns))
    wrong = 0
    for label in first:
        truth = first[label.replace("float32", "float64")]
        apart = {column: distance(arrays[label], truth) for column, arrays in columns.items()}
        allowed = max(10 * max(apart[isa] for isa in ours), LIMIT if label.endswith("float64") else 0.0)
        bad = apart["there"] > allowed
        wrong += bad
        print(f"{label:<24}" + "".join(f"{value:>10.1e}" for value in apart.values()) + "  <-" * bad)
    print(f"{len(first)} arrays, {wrong} of them wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
