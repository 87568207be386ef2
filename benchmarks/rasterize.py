"""Times the rasterizer, forward and forward + backward, on scenes of a given generator.

    python benchmarks/rasterize.py --yardstick DIR [--gaussians 10000 50000] [--size 400] [--threads 2]

DIR holds `bench_scene.py` with `make_scene(n)`, `camera(size)` and `target_image(height, width)`. The loss is the mean
L1 to the target, as in the yardstick's own tables; times include autograd. Prints median (minimum) in ms.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import time
from pathlib import Path
from types import ModuleType

import torch
from torch import Tensor

from graings import kernel
from graings.camera import Camera
from graings.gaussians import Gaussians
from graings.raster.photometric import ssim
from graings.raster.rasterize import rasterize
from graings.threads import use_threads


def load_yardstick(folder: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("bench_scene", folder / "bench_scene.py")
    if spec is None or spec.loader is None or not (folder / "bench_scene.py").is_file():
        raise SystemExit(f"{folder / 'bench_scene.py'} not found: give its folder with --yardstick")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def scene(yardstick: ModuleType, count: int, size: int) -> tuple[Gaussians, Camera, Tensor]:
    raw, view = yardstick.make_scene(count), yardstick.camera(size)
    leaves = {name: torch.from_numpy(raw[name]) for name in ("means", "quats", "opacities", "colors")}
    leaves["log_scales"] = torch.from_numpy(raw["scales"]).log()
    gaussians = Gaussians(**{k: v.requires_grad_() for k, v in leaves.items()}, uids=torch.arange(count))
    camera = Camera(view["viewmat"], view["fx"], view["fy"], view["cx"], view["cy"], view["W"], view["H"])
    return gaussians, camera, torch.from_numpy(yardstick.target_image(size, size))


def milliseconds(rounds: int, *calls: object) -> list[str]:
    """Median (minimum) of each call, taken in turns so that a busy neighbour hits all of them alike."""
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(rounds + 2):
        for call, mine in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()  # type: ignore[operator]
            mine.append(1e3 * (time.perf_counter() - start))
    return [f"{statistics.median(mine[2:]):6.1f} ({min(mine[2:]):5.1f})" for mine in times]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--yardstick", type=Path, required=True)
    parser.add_argument("--gaussians", type=int, nargs="+", default=[10_000, 50_000])
    parser.add_argument("--size", type=int, nargs="+", default=[400])
    parser.add_argument("--threads", type=int, default=kernel.usable_cores())
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args()
    yardstick = load_yardstick(options.yardstick)
    use_threads(options.threads)
    print(f"{kernel.active_isa()}, {options.threads} threads, median (minimum) of {options.rounds} in ms")
    print(f"{'scene':>12}  {'forward':>15}  {'forw.+backw.':>15}  {'SSIM + gradient':>15}")
    for count in options.gaussians:
        for size in options.size:
            gaussians, camera, target = scene(yardstick, count, size)
            background = torch.zeros(3)

            def forward(g: Gaussians = gaussians, c: Camera = camera, b: Tensor = background) -> Tensor:
                return rasterize(g, c, b).color

            def both(t: Tensor = target) -> None:
                (forward() - t).abs().mean().backward()

            image = forward().detach().requires_grad_()

            def similarity(i: Tensor = image, t: Tensor = target) -> None:
                ssim(i, t).backward()

            row = "  ".join(f"{cell:>15}" for cell in milliseconds(options.rounds, forward, both, similarity))
            print(f"{count // 1000:>7}k/{size:<4}  {row}", flush=True)


if __name__ == "__main__":
    main()
