"""What each single addition of ours is worth in a finished preset: each is undone alone, as the paper has it.

    python benchmarks/leave_one_out.py FOLDER CAPTURE... [--preset draft] [--seeds 0 1 2] [--only NAME ...]

The ladder (ladder.py) adds groups one after the other; here everything else stays as the preset has it, so an addition
that others make superfluous shows no difference. Runs lie in FOLDER/CAPTURE/NAME_SEED; what is finished is not
repeated, an interrupted run is resumed. FOLDER/leave_one_out.md is written after every run: PSNR of the validation
views of the full preset in dB, what undoing an addition changes (mean and standard error over paired seeds), and CPU
seconds of training.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from ladder import option
from runs import finished, train

from graings.config import TrainConfig, make_config
from graings.report.metrics_document import Metrics

PAPER = make_config("paper")
FULL = "full"


@dataclass(frozen=True)
class Addition:
    """One change of ours: the options, by dotted name, that take their value of `paper` to undo it."""

    name: str
    options: tuple[str, ...]


ADDITIONS = (
    Addition(FULL, ()),
    Addition("temporal_mean", ("loss.temporal_sum",)),
    Addition("rigidity", ("loss.rigidity",)),
    Addition("squared_error", ("loss.squared",)),
    Addition("alpha_loss", ("loss.alpha",)),
    Addition("relative_scales", ("scene.relative_scales",)),
    Addition("parent_opacity", ("density.new_anchor_opacity", "scene.child_opacity_offsets")),
    Addition("opacity_without_view", ("scene.opacity_view",)),
    Addition("view_harmonics", ("scene.color_sh_degree",)),
    Addition("reflection", ("scene.reflection",)),
    Addition("residual_view", ("scene.residual_sh_degree",)),
    Addition("narrow_filter", ("scene.blur",)),
    Addition("projected_clip", ("scene.projected_clip",)),
    Addition("muon", ("matrix_optimizer",)),
    Addition("averaging", ("average_from",)),
    Addition("unseen_anchors", ("density.unseen_pixels",)),
)


def config_of(addition: Addition, preset: str, seed: int, threads: int) -> TrainConfig:
    """Options of the preset with one addition undone."""
    undone: dict[str, Any] = {name: option(PAPER, name) for name in addition.options}
    return make_config(preset, {**undone, "seed": seed, "threads": threads})


def differs(addition: Addition, preset: str) -> bool:
    """Whether undoing this addition changes an option of the preset."""
    base = make_config(preset)
    return addition.name == FULL or any(option(base, name) != option(PAPER, name) for name in addition.options)


def folder_of(folder: Path, capture: Path, addition: Addition, seed: int) -> Path:
    return folder / capture.name / f"{addition.name}_{seed}"


def cells(folder: Path, capture: Path, addition: Addition, seeds: list[int]) -> list[str]:
    """PSNR or its difference to the full preset, and CPU seconds, over the seeds that both have."""
    runs = [finished(folder_of(folder, capture, addition, seed)) for seed in seeds]
    full = [finished(folder_of(folder, capture, ADDITIONS[0], seed)) for seed in seeds]
    pairs = [(run, base) for run, base in zip(runs, full, strict=True) if run is not None and base is not None]
    if not pairs:
        return ["", ""]
    seconds = f"{fmean(run.train_cpu_s for run, _ in pairs):.0f}"
    if addition.name == FULL:
        return [f"{fmean(psnr(run) for run, _ in pairs):.2f}", seconds]
    change = [psnr(run) - psnr(base) for run, base in pairs]
    error = f" ± {stdev(change) / len(change) ** 0.5:.2f}" if len(change) > 1 else ""
    return [f"{fmean(change):+.2f}{error}", seconds]


def psnr(metrics: Metrics) -> float:
    return metrics.splits["val"].psnr


def table(folder: Path, captures: list[Path], preset: str, seeds: list[int]) -> Iterator[str]:
    """The table as Markdown."""
    yield "| undone | " + " | ".join(f"{capture.name}: dB | CPU s" for capture in captures) + " |"
    yield "|---" * (1 + 2 * len(captures)) + "|"
    for addition in ADDITIONS:
        if differs(addition, preset):
            columns = [cell for capture in captures for cell in cells(folder, capture, addition, seeds)]
            yield f"| {addition.name} | " + " | ".join(columns) + " |"


def main() -> None:
    """Train every row, seed after seed, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--threads", type=int, default=1)
    names = [addition.name for addition in ADDITIONS]
    parser.add_argument("--only", nargs="+", default=names, choices=names)
    args = parser.parse_args()
    wanted = [row for row in ADDITIONS if row.name in {FULL, *args.only} and differs(row, args.preset)]
    for seed in args.seeds:
        for capture in args.captures:
            for addition in wanted:
                config = config_of(addition, args.preset, seed, args.threads)
                train(folder_of(args.folder, capture, addition, seed), capture, config)
                lines = table(args.folder, args.captures, args.preset, args.seeds)
                (args.folder / "leave_one_out.md").write_text("\n".join(lines) + "\n")
    print("\n".join(table(args.folder, args.captures, args.preset, args.seeds)))


if __name__ == "__main__":
    main()
