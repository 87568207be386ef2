"""The ladder from the method as printed to preset `fine`: what each group of our additions is worth.

    python benchmarks/ladder.py FOLDER CAPTURE... [--views 20000] [--seed 0] [--threads 1] [--only ROW ...]

Every row keeps the additions of the rows above it. All rows see equally many training views at 400 px; the last row is
`fine` at that length, which the script checks before it trains. Runs lie in FOLDER/CAPTURE/ROW; what is finished is not
repeated, an interrupted run is resumed. FOLDER/ladder.md is written after every run: PSNR of the validation
views in dB and its difference to the row above, CPU minutes of training, MB in float32.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runs import finished, train

from graings.config import TrainConfig, make_config

FINE = make_config("fine")
BATCH = FINE.batch


@dataclass(frozen=True)
class Row:
    """One step of the ladder: the options, by dotted name, that take their value of `fine` from here on."""

    name: str
    label: str
    options: tuple[str, ...]


ROWS = (
    Row("printed", "the method as printed", ()),
    Row(
        "batch",
        "four views a step, short warm-up, growth every 50 steps, products of networks in bfloat16 where the CPU can",
        ("batch", "warmup", "density.grow_every", "network_precision"),
    ),
    Row("time", "time conditioning factorized", ("scene.time_conditioning",)),
    Row(
        "losses",
        "L_temp a mean over time, rigidity, squared error after growth, alpha loss",
        ("loss.temporal_sum", "loss.rigidity", "loss.squared", "loss.alpha"),
    ),
    Row(
        "appearance",
        "new anchors as opaque as their parent, opacity without the view, view harmonics, residual that sees the view",
        (
            "scene.relative_scales",
            *("density.new_anchor_opacity", "scene.child_opacity_offsets"),
            "scene.opacity_view",
            *("scene.color_sh_degree", "scene.reflection", "scene.residual_sh_degree"),
        ),
    ),
    Row("rasterizer", "low-pass filter 0.1, projected clips", ("scene.blur", "scene.projected_clip")),
    Row("optimizer", "Muon for weight matrices", ("matrix_optimizer",)),
    Row(
        "initialization",
        "first points thinned to an anchor budget that growth keeps",
        ("init.max_points", "density.max_growth", "density.max_anchors", "density.memory_mb"),
    ),
    Row(
        "end",
        "last steps averaged, anchors that no training view shows removed",
        ("average_from", "density.unseen_pixels"),
    ),
    Row(
        "curriculum",
        "time window, guard that rolls back, background of the capture, plan",
        ("time_window", "guard", "capture.background", "plan"),
    ),
)


def option(config: TrainConfig, name: str) -> Any:
    value: Any = config
    for part in name.split("."):
        value = getattr(value, part)
    return value.model_dump() if hasattr(value, "model_dump") else value


def config_of(index: int, views: int, seed: int, threads: int) -> TrainConfig:
    """Options of row `index` at this many training views."""
    taken = {name: option(FINE, name) for row in ROWS[: index + 1] for name in row.options}
    batch = taken.get("batch", 1)
    run = {"iterations": views // batch, "capture.max_side": 400, "seed": seed, "threads": threads}
    return make_config("paper", {**taken, **run})


def check_ladder(views: int) -> None:
    """Raise `SystemExit` naming the options in which the last row is not `fine`."""
    end = config_of(len(ROWS) - 1, views, 0, 1).model_dump()
    fine = make_config("fine", {"iterations": views // BATCH, "seed": 0, "threads": 1}).model_dump()
    different = [key for key in fine if key != "preset" and end[key] != fine[key]]
    if different:
        raise SystemExit(f"the last row is not fine: {different}. Add the options to a row.")


def table(folder: Path, captures: list[Path]) -> Iterator[str]:
    """The table as Markdown."""
    yield "| row | " + " | ".join(f"{c.name}: dB | to the row above | CPU min | MB" for c in captures) + " |"
    yield "|---" * (1 + 4 * len(captures)) + "|"
    above: dict[Path, float | None] = dict.fromkeys(captures)
    for row in ROWS:
        cells = [row.label]
        for capture in captures:
            metrics = finished(folder / capture.name / row.name)
            psnr = None if metrics is None else metrics.splits["val"].psnr
            before, above[capture] = above[capture], psnr
            if metrics is None or psnr is None:
                cells += ["", "", "", ""]
                continue
            cells += [
                f"{psnr:.2f}",
                "" if before is None else f"{psnr - before:+.2f}",
                f"{metrics.train_cpu_s / 60:.0f}",
                f"{metrics.bytes.fp32 / 1e6:.2f}",
            ]
        yield "| " + " | ".join(cells) + " |"


def main() -> None:
    """Train the ladder and write its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--views", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=[row.name for row in ROWS], choices=[row.name for row in ROWS])
    args = parser.parse_args()
    check_ladder(args.views)
    for capture in args.captures:
        for index, row in enumerate(ROWS):
            if row.name in args.only:
                config = config_of(index, args.views, args.seed, args.threads)
                train(args.folder / capture.name / row.name, capture, config)
                (args.folder / "ladder.md").write_text("\n".join(table(args.folder, args.captures)) + "\n")
    print("\n".join(table(args.folder, args.captures)))


if __name__ == "__main__":
    main()
