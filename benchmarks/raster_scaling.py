"""How the rasterizer's time scales with Gaussians, pixels and threads, by stage.

    python benchmarks/raster_scaling.py --yardstick DIR -o FOLDER [--rounds 11]

DIR holds `bench_scene.py` (see rasterize.py). Writes FOLDER/raster_scaling.{json,svg} and prints, for every stage, the
slope of log time against log size: 1 is linear, 0 is constant. Medians of wall-clock milliseconds of one forward +
backward.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any

import scenes
import torch
from rasterize import Ours
from scaling import write_scaling

from graings import kernel
from graings.kernel import use_threads

COUNTS = (10_000, 25_000, 50_000, 100_000, 200_000)
SIZES = (200, 400, 800, 1600)


def stages(ours: Ours, rounds: int) -> dict[str, float]:
    """Median milliseconds of every stage."""
    seen: dict[str, list[float]] = {}
    for turn in range(rounds + 2):
        color = ours.result().color
        upstream = torch.sign(color.detach() - ours.target) / ours.target.numel()
        frame: Any = color.grad_fn.frame
        torch.autograd.grad(color, list(ours.leaves.values()), upstream)
        if turn >= 2:
            for name, seconds in frame.seconds.items():
                seen.setdefault(name, []).append(1e3 * seconds)
    return {name: statistics.median(values) for name, values in seen.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--yardstick", type=Path, required=True)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=11)
    options = parser.parse_args()

    def measure(count: int, size: int, threads: int) -> dict[str, float]:
        use_threads(threads)
        return stages(Ours(scenes.named(f"{count}/{size}", options.yardstick)), options.rounds)

    cores = kernel.usable_cores()
    series: dict[str, dict[int, dict[str, float]]] = {
        "Gaussians, at 800 px": {count: measure(count, 800, cores) for count in COUNTS},
        "pixels, with 50 000 Gaussians": {size * size: measure(50_000, size, cores) for size in SIZES},
        "threads, 200 000 Gaussians at 800 px": {n: measure(200_000, 800, n) for n in range(1, cores + 1)},
    }
    document = {
        "title": "What one forward + backward of the rasterizer costs",
        "isa": kernel.active_isa(),
        "threads": cores,
        "series": {title: {str(x): row for x, row in rows.items()} for title, rows in series.items()},
    }
    write_scaling(options.output, "raster_scaling", document)


if __name__ == "__main__":
    main()
