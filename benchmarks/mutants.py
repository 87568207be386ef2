"""Mutation tests: breaks the formulas one at a time and reports which test fails.

    python benchmarks/mutants.py [--only a,b] [--list] [--keep DIR]

A mutant is a small change of the source, the replacement of one text by another. Each is applied to a copy of the
package in a temporary folder, the kernel is rebuilt if C++ changed, and the fast tests run until the first one fails. A
mutant that no test detects has survived, and the exit code is 1. The text to replace must occur exactly once; the
script names mutants whose formula has been rewritten.

Most break the rasterizer and are run against tests/raster. Mutant (i) rounds times before they are normalised and is
run against the tests of normalisation. The last ones break the rest of the kernel: networks, encodings and children,
run against tests/scene, and the loss. Mutant (e) cuts a footprint at three standard deviations, which in this kernel is
a limit of the exponent and not a square; mutant (g) computes the position in the camera in float32 if pixels are
float32; mutant (h) ignores the uids, so that the order of rows decides; mutant (l) leaves flags uninitialised, which
matters only in reused memory.

Mutants (j) to (m) break the backward pass of a tile; (n) to (p) and the five that follow break the selection of tiles
and blocks of a Gaussian, and their order.

Tests that fail without any mutant are named and left out.
Needs a compiler, CMake and nanobind (pip install nanobind); takes a few minutes per mutant. Set GRAINGS_ISA to choose
the instruction set that tests run with unless they select one themselves.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from working_copy import WorkingCopy

ROOT = Path(__file__).resolve().parent.parent
SOURCE = "graings/kernel/csrc"
RASTER = ("tests/raster",)
FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", re.MULTILINE)
IN_A_TEST = re.compile(r"^(tests/\S+::.*\S) \Z", re.MULTILINE)  # started, but without a result


@dataclass(frozen=True, slots=True)
class Mutant:
    name: str
    what: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...] = RASTER

    @property
    def needs_build(self) -> bool:
        return self.file.startswith(SOURCE)


GEOMETRY, BINNING = f"{SOURCE}/geometry.hpp", f"{SOURCE}/binning.cpp"
TILES, TILE_GRADIENT, RANKS = (f"{SOURCE}/{name}.hpp" for name in ("tiles", "tile_gradient", "ranks"))
FRAME = f"{SOURCE}/frame.cpp"
SCENE = ("tests/scene",)

MUTANTS = (
    Mutant(
        "a",
        "determinant as a c - b b",
        GEOMETRY,
        "fma(h, h, fma(h, xx + yy, dot3(cross, cross)))",
        "(xx + h) * (yy + h) - xy * xy",
    ),
    Mutant(
        "b",
        "exclusive stop",
        TILES,
        "if constexpr (Compat) {",
        "if constexpr (Compat || true) {",
    ),
    Mutant(
        "c",
        "factor 2 kept where the ratio is clamped",
        GEOMETRY,
        "g_z - iz * (to_x * p.ratio_x + to_y * p.ratio_y)",
        "g_z - iz * ((g_clamped_x * p.clamped_x + fx * g_x * p.ratio_x)"
        " + (g_clamped_y * p.clamped_y + fy * g_y * p.ratio_y))",
    ),
    Mutant("d", "quaternion gradient not projected", GEOMETRY, "(q[i] - radial * p.quat[i])", "(q[i])"),
    Mutant(
        "e",
        "footprint of three standard deviations",
        GEOMETRY,
        "fma(level, d8(1 + 1e-5), slack), d8(1e30))",
        "fma(level, d8(1 + 1e-5), slack), d8(4.5 * kLog2E))",
    ),
    Mutant(
        "f",
        "slope missing in the gradient of y",
        GEOMETRY,
        "total[kS] * inverse_sy * p.inverse_c - p.slope * g_x",
        "total[kS] * inverse_sy * p.inverse_c",
    ),
    Mutant(
        "g",
        "geometry in float32",
        GEOMETRY,
        "    p.z = camera[2];\n",
        """    if constexpr (sizeof(R) == 4) {
        double from[3][kGroup], to[kGroup];
        for (int i = 0; i < 3; i++) store(from[i], away[i]);
        for (int i = 0; i < 3; i++) {
            for (int lane = 0; lane < kGroup; lane++) {
                float sum = 0;
                for (int j = 0; j < 3; j++) sum += float(k.rotation[3 * i + j]) * float(from[j][lane]);
                to[lane] = double(sum);
            }
            camera[i] = load<kGroup>(to);
        }
    }
    p.z = camera[2];
""",
    ),
    Mutant(
        "h",
        "ties of depth decided by the row",
        BINNING,
        "std::tuple(depths_[a.id], uids_[a.id], a.id) < std::tuple(depths_[b.id], uids_[b.id], b.id)",
        "std::tuple(depths_[a.id], uids_[0], a.id) < std::tuple(depths_[b.id], uids_[0], b.id)",
    ),
    Mutant(
        "i",
        "times in float32 before they are normalised",
        "graings/camera/units.py",
        "(float(time) - self.time_start)",
        "(float(np.float32(time)) - self.time_start)",
        ("tests/capture/test_normalize.py",),
    ),
    Mutant(
        "j",
        "transmittance multiplied in the backward pass, not divided",
        TILE_GRADIENT,
        "load<N>(of(light)) / (all_of(R(1)) - alpha)",
        "load<N>(of(light)) * (all_of(R(1)) - alpha)",
    ),
    Mutant(
        "k",
        "gradient counts entries behind the stop",
        TILE_GRADIENT,
        "(all_of(limits.alpha_min) <= evaluated.raw) & "
        "(all_of(entry.number) <= load<N>(last[evaluated.block] + evaluated.first))",
        "all_of(limits.alpha_min) <= evaluated.raw",
    ),
    Mutant(
        "l",
        "flags of pairs that were not drawn left uninitialised",
        FRAME,
        "std::fill_n(shown.get(), 64 * words, uint8_t(0))",
        "std::fill(shown.get() + pair_count_, shown.get() + 64 * words, uint8_t(0))",
    ),
    Mutant(
        "m", "sign of the sum of s flipped", TILE_GRADIENT, "total.es = total.es + ge_s", "total.es = total.es - ge_s"
    ),
    Mutant(
        "n",
        "rectangle of blocks one too narrow on the right",
        GEOMETRY,
        "block(first_x), block(last_x), block(first_y)",
        "block(first_x), block(last_x) - one, block(first_y)",
    ),
    Mutant(
        "o",
        "blocks selected as if there were no tilt",
        TILES,
        "p16(margin) * (wide + tilt)",
        "p16(margin) * wide",
    ),
    Mutant(
        "p",
        "equal keys of depth taken for equal depths and uids",
        BINNING,
        "if (a.key != b.key) return a.key < b.key;",
        "return a.key < b.key;",
    ),
    Mutant(
        "depth-rounded",
        "uids decide between depths of equal keys",
        BINNING,
        "std::tuple(depths_[a.id], uids_[a.id], a.id) < std::tuple(depths_[b.id], uids_[b.id], b.id)",
        "std::tuple(uids_[a.id], a.id) < std::tuple(uids_[b.id], b.id)",
    ),
    Mutant(
        "rows-short",
        "blocks selected as if they were a pixel less high",
        TILES,
        "p16(margin) * rise",
        "rise",
    ),
    Mutant(
        "no-slack",
        "blocks selected without slack for rounding",
        TILES,
        "constexpr R margin = R(1.5) + (sizeof(R) == 4 ? R(6e-5) : R(1e-13));",
        "constexpr R margin = R(1.5);",
    ),
    Mutant(
        "row-narrow",
        "rows of tiles end one tile early on the right",
        BINNING,
        "last = std::min(uint32_t(to) / kTile, span.last_column());",
        "last = std::min((uint32_t(to) - 1) / kTile, span.last_column());",
    ),
    Mutant(
        "tilt-missing",
        "rows of tiles end as if there were no tilt",
        BINNING,
        "std::clamp(side * turn, low, high)",
        "std::clamp(0.0, low, high)",
    ),
    Mutant(
        "slope-halved",
        "gradient of the slope halved",
        GEOMETRY,
        "g_slope = total[kRS]",
        "g_slope = d8(0.5) * total[kRS]",
    ),
    Mutant(
        "third-sum",
        "the third of a Gaussian's partial sums skipped",
        GEOMETRY,
        "for (uint32_t at = first + 2;",
        "for (uint32_t at = first + 3;",
    ),
    Mutant(
        "unwritten",
        "sums of entries without an active block not written",
        TILE_GRADIENT,
        "put_zeros(entries[j].place);",
        "",
    ),
    Mutant(
        "unwritten-tile",
        "sums of a tile without an active block not written",
        TILE_GRADIENT,
        "put_zeros(args.pairs[k].place);",
        ";",
    ),
    Mutant(
        "renumbered",
        "entries numbered among the drawn ones, not among all",
        TILE_GRADIENT,
        "double(box.top), entries[j].key);",
        "double(box.top), j);",
    ),
    Mutant(
        "rank",
        "the nearest place before one not counted",
        RANKS,
        "((uint64_t(1) << place % 64) - 1)",
        "(((uint64_t(1) << place % 64) - 1) >> 1)",
    ),
    Mutant(
        "reason",
        "the last reason for culling counted, not the first",
        GEOMETRY,
        "status = select(has_direction, status, d8(kZeroQuat)), status = select(finite, status, d8(kNonFinite)),",
        "status = select(finite, status, d8(kNonFinite)), status = select(has_direction, status, d8(kZeroQuat)),",
    ),
    Mutant(
        "cap-passed",
        "gradient passed through the cap of alpha",
        TILE_GRADIENT,
        "select(evaluated.raw <= all_of(limits.alpha_max), weight * gain, none)",
        "weight * gain",
    ),
    Mutant(
        "j-dropped",
        "no gradient through the last column of the Jacobian",
        GEOMETRY,
        "g_clamped_x = -(fx * iz * j02), g_clamped_y = -(fy * iz * j12);",
        "g_clamped_x = d8(0) * j02, g_clamped_y = d8(0) * j12;",
    ),
    Mutant(
        "background",
        "background missing behind the last Gaussian",
        TILE_GRADIENT,
        "ground = fma(g, p16(args.background[c]), ground);",
        "ground = fma(g, p16(R(0)), ground);",
    ),
    Mutant(
        "columns-narrow",
        "blocks of a tile end one column early on the right",
        BINNING,
        "kColumnsTo[] = {0x1111, 0x3333,",
        "kColumnsTo[] = {0x1111, 0x1111,",
    ),
    Mutant(
        "bits-missing",
        "pairs that agree in the leading bits of the key left unsorted",
        BINNING,
        "if (!before(pairs[i], pairs[i - 1])) continue;",
        "if (before(pairs[i], pairs[i]) || count > kMaxInsertionSort) continue;",
    ),
    Mutant(
        "long-sort",
        "insertion sort ended early without a fallback",
        BINNING,
        "std::sort(pairs, pairs + count, before);",
        "",
    ),
    Mutant(
        "next-unseen",
        "the next entry dropped from the backward pass instead of an invisible one",
        TILES,
        "unseen |= uint64_t(!any(seen)) << j;",
        "unseen |= uint64_t(!any(seen)) << (j + 1) % kChunk;",
    ),
    Mutant(
        "dead-block",
        "entries dropped from all blocks when one block has stopped",
        TILES,
        "pairs[k + __builtin_ctzll(list)].mask &= ~(1u << b);",
        "pairs[k + __builtin_ctzll(list)].mask = 0;",
    ),
    Mutant(
        "not-closed",
        "sums of an entry left open when the next one begins",
        TILE_GRADIENT,
        "            if (open >= 0) close();\n            open = j",
        "            open = j",
    ),
    Mutant(
        "ready-places",
        "an entry prepared in place of the one still in use",
        TILE_GRADIENT,
        "    constexpr int kReady = 16;\n    static_assert(kReady > kReadyAhead + 1);\n",
        "    constexpr int kReady = 9;\n",
    ),
    Mutant(
        "group-split",
        "gradient of a group missing at the boundary of two pieces of work",
        f"{SOURCE}/perceptron.cpp",
        "to[c] += own[args.first_group_at + c];",
        "to[c] += R(0);",
        SCENE,
    ),
    Mutant(
        "relu-passed",
        "gradient passed through a closed ReLU",
        f"{SOURCE}/layers.hpp",
        "select(load<width>(levels[l] + r * in + c) <= zero, zero, sum)",
        "select(load<width>(levels[l] + r * in + c) <= zero, sum, sum)",
        SCENE,
    ),
    Mutant(
        "panels",
        "panels of weights that overlap",
        f"{SOURCE}/packed.hpp",
        "(column / kPanel * rows + row) * kPanel",
        "(column / kPanel + row) * kPanel",
        SCENE,
    ),
    Mutant(
        "shared-row",
        "the part of another anchor's feature",
        f"{SOURCE}/prepared.cpp",
        "args.shared += first * args.widths[1]",
        "args.shared += 0 * args.widths[1]",
        SCENE,
    ),
    Mutant(
        "moved-lane",
        "offsets in time of another child of the block",
        f"{SOURCE}/motion.hpp",
        "const int64_t at = args.rows[begin] % kMoving;",
        "const int64_t at = (args.rows[begin] ^ 1) % kMoving;",
        SCENE,
    ),
    Mutant(
        "kept-child",
        "a child left out that the residual lifts above the threshold",
        "graings/scene/prepared.py",
        "(0.0 if residual is None else residual.scale)",
        "(0.0 if residual is None else 0.9 * residual.scale)",
        SCENE,
    ),
    Mutant(
        "octave",
        "cosine doubled with the sine already doubled",
        f"{SOURCE}/encoding.cpp",
        "cosine = (cosine - sine) * (cosine + sine), sine = twice;",
        "sine = twice, cosine = (cosine - sine) * (cosine + sine);",
        SCENE,
    ),
    Mutant(
        "mirror",
        "gradient of a reflection without the rotation of its normal",
        f"{SOURCE}/encoding.cpp",
        "out[i] = R(-2 * (along * v[i] + turned * (direction[i] - 2 * along * normal[i])));",
        "out[i] = R(-2 * (along * v[i] + turned * direction[i]));",
        SCENE,
    ),
    Mutant(
        "adjoint",
        "gradient rotated forwards, not back",
        f"{SOURCE}/children.cpp",
        "v_quat = product(v_quat, conjugate(deformed_rotation(deformation)));",
        "v_quat = product(v_quat, deformed_rotation(deformation));",
        SCENE,
    ),
    Mutant(
        "rim",
        "differing part one pixel too narrow",
        f"{SOURCE}/photometric.cpp",
        "kReach = kSsimRadius;",
        "kReach = kSsimRadius - 1;",
    ),
    Mutant(
        "stale",
        "gradient outside all windows left uninitialised",
        f"{SOURCE}/ssim.hpp",
        "std::memset(map, 0, sizeof(R) * size_t(args.windows[y].begin));",
        "",
    ),
    Mutant(
        "cut-off",
        "row sums restricted to numbers with a difference",
        f"{SOURCE}/ssim.hpp",
        "each_register<R>(widened(args.windows[y], length)",
        "each_register<R>(args.windows[y]",
    ),
    Mutant(
        "square",
        "factor 2 missing in the gradient of the squared difference",
        f"{SOURCE}/ssim.hpp",
        "R(2) * args.squared",
        "args.squared",
    ),
)


def apply(copy: WorkingCopy, mutant: Mutant) -> str:
    """Change the source; returns the original. Raises `SystemExit` unless the text occurs exactly once."""
    path = copy.folder / mutant.file
    before = path.read_text(encoding="utf-8")
    if (count := before.count(mutant.old)) != 1:
        raise SystemExit(f"mutant {mutant.name}: its text occurs {count} times in {mutant.file}, expected once")
    path.write_text(before.replace(mutant.old, mutant.new), encoding="utf-8")
    return before


def failures(copy: WorkingCopy, tests: Sequence[str], *options: str) -> list[str]:
    """Ids of the tests that fail, or of the one in which a signal ended the interpreter.

    Raises `SystemExit` if they could not be run.
    """
    ran = copy.pytest("-v", "-m", "not slow", *options, *tests)
    failed = FAILED.findall(ran.stdout)
    if ran.returncode < 0 and (ended := IN_A_TEST.search(ran.stdout)):
        return [ended[1]]
    if ran.returncode not in (0, 1) or (ran.returncode == 1) != bool(failed):
        raise SystemExit(f"pytest could not run:\n{ran.stdout[-4000:]}\n{ran.stderr[-4000:]}")
    return failed


def chosen(only: str | None) -> list[Mutant]:
    if only is None:
        return list(MUTANTS)
    known = {mutant.name: mutant for mutant in MUTANTS}
    names = only.split(",")
    if unknown := [name for name in names if name not in known]:
        raise SystemExit(f"no mutant {', '.join(unknown)}; there are {', '.join(known)}")
    return [known[name] for name in names]


def check_texts(mutants: Sequence[Mutant]) -> None:
    """Check first that every text occurs exactly once."""
    for mutant in mutants:
        if (count := (ROOT / mutant.file).read_text(encoding="utf-8").count(mutant.old)) != 1:
            raise SystemExit(f"mutant {mutant.name}: its text occurs {count} times in {mutant.file}, expected once")


def try_mutants(copy: WorkingCopy, mutants: Sequence[Mutant]) -> dict[str, str | None]:
    """The first test that each mutant fails, None if it survives."""
    copy.build()
    tests = sorted({test for mutant in mutants for test in mutant.tests})
    broken = failures(copy, tests)
    for test in broken:
        print(f"fails already, left out: {test}", flush=True)
    deselected = [f"--deselect={test}" for test in broken]
    detected_by: dict[str, str | None] = {}
    built_as_is = True
    for mutant in mutants:
        before = apply(copy, mutant)
        if mutant.needs_build or not built_as_is:
            copy.build()
            built_as_is = not mutant.needs_build
        failed = failures(copy, mutant.tests, "-x", *deselected)
        (copy.folder / mutant.file).write_text(before, encoding="utf-8")
        detected_by[mutant.name] = failed[0] if failed else None
        print(f"{mutant.name:13} {mutant.what:52} {detected_by[mutant.name] or 'SURVIVED'}", flush=True)
    return detected_by


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="NAMES", help="these mutants, separated by commas")
    parser.add_argument("--list", action="store_true", help="print the mutants and check that their texts occur")
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="work in this folder, which must not exist, and keep it"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="compilers at a time")
    options = parser.parse_args()
    mutants = chosen(options.only)
    check_texts(mutants)
    if options.list:
        for mutant in mutants:
            print(f"{mutant.name:13} {mutant.what:52} {mutant.file}")
        return 0
    if options.keep is not None:
        options.keep.mkdir(parents=True)
        detected_by = try_mutants(WorkingCopy(ROOT, options.keep.resolve(), options.jobs), mutants)
    else:
        with tempfile.TemporaryDirectory() as folder:
            detected_by = try_mutants(WorkingCopy(ROOT, Path(folder).resolve(), options.jobs), mutants)
    survivors = [name for name, test in detected_by.items() if test is None]
    print(
        f"{len(detected_by) - len(survivors)} of {len(detected_by)} detected_by"
        + (f"; survived: {', '.join(survivors)}" * bool(survivors))
    )
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
