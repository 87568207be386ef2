"""Runs the kernel's tests on its AVX-512 code on a CPU that has only AVX2.

    python benchmarks/avx512_elsewhere.py [pytest's arguments]

Works in a copy of the package in a temporary folder, where the AVX-512 code is compiled for AVX2; its intrinsics are
emulated by SIMDe (Debian: libsimde-dev) and avx512_elsewhere.hpp. This tests the source, not the compiler's output
for AVX-512. Without further arguments tests/raster and tests/scene run; the exit code is pytest's.

It does not measure speed: the copy is many times slower. Needs GCC, CMake and nanobind.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
from pathlib import Path

from working_copy import WorkingCopy

ROOT = Path(__file__).resolve().parent.parent
SOURCES = "graings/kernel/csrc"
OWN_HEADER = Path(__file__).with_suffix(".hpp")
FUNCTION = re.compile(r"_mm512_(\w+)")
OWN_FUNCTION = re.compile(r"^static inline \S+ (\w+)\(", re.MULTILINE)
FLAGS = re.compile(r"add_kernels\(avx512 [^)]*\)")


def header() -> str:
    """The own functions, and a macro for every AVX-512 intrinsic that the kernel calls."""
    own_header = OWN_HEADER.read_text(encoding="utf-8")
    own = set(OWN_FUNCTION.findall(own_header))
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / SOURCES).glob("*.hpp")]
    called = sorted({name for source in sources for name in FUNCTION.findall(source)})
    names = [
        f"#undef _mm512_{name}\n#define _mm512_{name} {'elsewhere::' if name in own else 'simde_mm512_'}{name}\n"
        for name in called
    ]
    return own_header + "".join(names)


def build(folder: Path) -> WorkingCopy:
    """A copy whose AVX-512 kernel runs here. Raises `SystemExit` if it cannot be built."""
    included = folder / "avx512.hpp"
    included.write_text(header(), encoding="utf-8")
    (folder / "copy").mkdir()
    copy = WorkingCopy(ROOT, folder / "copy", os.cpu_count() or 1)
    cmake = copy.folder / "CMakeLists.txt"
    flags = f"add_kernels(avx512 -mavx2 -mfma -mpopcnt -mbmi -O2 -w -include {included})"
    changed, count = FLAGS.subn(flags, cmake.read_text(encoding="utf-8"))
    if count != 1:
        raise SystemExit(f"the flags of avx512 occur {count} times in CMakeLists.txt, expected once")
    cmake.write_text(changed, encoding="utf-8")
    isa = copy.folder / SOURCES / "isa.cpp"
    override = "#define __builtin_cpu_supports(feature) true\n"
    isa.write_text(override + isa.read_text(encoding="utf-8"), encoding="utf-8")
    copy.build()
    return copy


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    _, arguments = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as name:
        copy = build(Path(name).resolve())
        tests = arguments or ["tests/raster", "tests/scene"]
        ran = copy.pytest("-q", "-m", "not slow", *tests, environment={"GRAINGS_ISA": "avx512"})
        print(ran.stdout, ran.stderr, sep="\n", end="")
    return ran.returncode


if __name__ == "__main__":
    sys.exit(main())
