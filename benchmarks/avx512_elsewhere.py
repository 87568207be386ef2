"""Runs the kernel's tests on its AVX-512 branches where the CPU has AVX2 alone.

    python benchmarks/avx512_elsewhere.py [pytest's arguments]

Works in a copy of the package in a temporary folder. There the kernel of AVX-512 is compiled for AVX2; the functions of
AVX-512 come from SIMDe (Debian: libsimde-dev) and avx512_elsewhere.hpp. So it tries what the source says, not what a
compiler makes of it for AVX-512. Without further arguments tests/raster and tests/scene run; the exit code is pytest's.

Says nothing of speed: the copy is many times slower. Needs GCC, CMake and nanobind.
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
BY_HAND = Path(__file__).with_suffix(".hpp")
FUNCTION = re.compile(r"_mm512_(\w+)")
OWN_FUNCTION = re.compile(r"^static inline \S+ (\w+)\(", re.MULTILINE)
FLAGS = re.compile(r"add_kernels\(avx512 [^)]*\)")


def header() -> str:
    """The functions by hand, and a name for every function of AVX-512 that the kernel calls."""
    by_hand = BY_HAND.read_text(encoding="utf-8")
    own = set(OWN_FUNCTION.findall(by_hand))
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / SOURCES).glob("*.hpp")]
    called = sorted({name for source in sources for name in FUNCTION.findall(source)})
    names = [
        f"#undef _mm512_{name}\n#define _mm512_{name} {'elsewhere::' if name in own else 'simde_mm512_'}{name}\n"
        for name in called
    ]
    return by_hand + "".join(names)


def build(folder: Path) -> WorkingCopy:
    """A copy whose kernel of AVX-512 runs here. Raises `SystemExit` where it cannot be built."""
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
    said = "#define __builtin_cpu_supports(feature) true\n"
    isa.write_text(said + isa.read_text(encoding="utf-8"), encoding="utf-8")
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
