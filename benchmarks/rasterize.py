"""Times the rasterizer against a yardstick, forward and forward + backward, on scenes of a given generator.

    python benchmarks/rasterize.py --yardstick DIR [--gaussians 10000 50000 200000] [--size 400 800] [--threads 1 2]
                                   [--rounds 15] [--json FILE] [--oracle]

DIR holds `bench_scene.py` with `make_scene(n)`, `camera(size)` and `target_image(height, width)`, and optionally
`limit_kernel.py` with a class `LimitKernel(scene, camera)` that has `forward()` and `fwd_bwd(target)`: the yardstick,
built when first used. Ours goes through the PyTorch function with its argument checks and gives colour, alpha and
depth; both take the sign of the difference to the target as upstream. They are timed in turn, so that a busy neighbour
hits both.

Prints median (minimum) in ms, the ratio of the medians, and the memory that one forward + backward takes at its peak.
`--oracle` adds the plain torch oracle (slow).
"""

from __future__ import annotations

import argparse
import importlib
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from graings import kernel
from graings.camera import Camera
from graings.gaussians import Gaussians
from graings.raster import reference
from graings.raster.photometric import photometric
from graings.raster.rasterize import rasterize
from graings.raster.result import RenderResult
from graings.threads import use_threads

Call = Callable[[], object]


def load(folder: Path, name: str) -> ModuleType | None:
    """A module of the yardstick's folder, or None where it has none."""
    if not (folder / f"{name}.py").is_file():
        return None
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    return importlib.import_module(name)


class Ours:
    """One scene drawn by a rasterizer of ours."""

    def __init__(self, raw: dict[str, Any], view: dict[str, Any], target: Tensor, draw: Any = rasterize) -> None:
        leaves = {name: torch.from_numpy(raw[name]) for name in ("means", "quats", "opacities", "colors")}
        leaves["log_scales"] = torch.from_numpy(raw["scales"]).log()
        self.leaves = {name: leaf.requires_grad_() for name, leaf in leaves.items()}
        self.gaussians = Gaussians(**self.leaves, uids=torch.arange(len(raw["means"])))
        self.camera = Camera(view["viewmat"], view["fx"], view["fy"], view["cx"], view["cy"], view["W"], view["H"])
        self.background = torch.zeros(3)
        self.target = target
        self.draw = draw

    def result(self) -> RenderResult:
        drawn: RenderResult = self.draw(self.gaussians, self.camera, self.background)
        return drawn

    def forward(self) -> None:
        with torch.no_grad():
            self.result()

    def both(self) -> None:
        color = self.result().color
        upstream = torch.sign(color.detach() - self.target) / self.target.numel()
        torch.autograd.grad(color, list(self.leaves.values()), upstream)

    def both_with_depth(self) -> None:
        result = self.result()
        upstream = torch.sign(result.color.detach() - self.target) / self.target.numel()
        extra = upstream[..., 0].contiguous()
        torch.autograd.grad(
            [result.color, result.alpha, result.depth], list(self.leaves.values()), [upstream, extra, extra]
        )


def in_turn(rounds: int, calls: dict[str, Call]) -> dict[str, list[float]]:
    """Milliseconds of each call, taken in turns after two to warm up."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 2):
        for name, call in calls.items():
            time.sleep(0.03)  # threads of the call before may still spin for 10 ms in wait for more
            start = time.perf_counter()
            call()
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: values[2:] for name, values in times.items()}


def peak_mb(folder: Path, count: int, size: int) -> float:
    """Resident memory that one forward + backward needs at its peak beyond its inputs, in a process of its own."""
    command = [sys.executable, __file__, "--yardstick", str(folder), "--measure-memory", str(count), str(size)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def measure_memory(scenes: ModuleType, count: int, size: int) -> float:
    """What `peak_mb` asks of its child."""
    ours = Ours(scenes.make_scene(count), scenes.camera(size), torch.from_numpy(scenes.target_image(size, size)))
    Ours(scenes.make_scene(100), scenes.camera(16), torch.zeros(16, 16, 3)).both()  # libraries come in
    before = _status_kb("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    ours.both()
    return (_status_kb("VmHWM") - before) / 1000


def _status_kb(field: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(field)).split()[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--yardstick", type=Path, required=True)
    parser.add_argument("--gaussians", type=int, nargs="+", default=[10_000, 50_000, 200_000])
    parser.add_argument("--size", type=int, nargs="+", default=[400, 800])
    parser.add_argument("--threads", type=int, nargs="+", default=[kernel.usable_cores()])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--oracle", action="store_true")
    parser.add_argument("--measure-memory", type=int, nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    scenes, limit = load(options.yardstick, "bench_scene"), load(options.yardstick, "limit_kernel")
    if scenes is None:
        parser.error(f"{options.yardstick / 'bench_scene.py'} not found: give its folder with --yardstick")
    if options.measure_memory is not None:
        print(measure_memory(scenes, *options.measure_memory))
        return
    rows = []
    print(f"{kernel.active_isa()}, median (minimum) of {options.rounds} in ms")
    print(f"{'scene':>9} {'thr':>3}  {'pass':<26} {'ours':>15}  {'yardstick':>15}  {'ratio':>6}  {'peak MB':>7}")
    for count in options.gaussians:
        for size in options.size:
            raw, view = scenes.make_scene(count), scenes.camera(size)
            target = scenes.target_image(size, size)
            ours = Ours(raw, view, torch.from_numpy(target))
            image = ours.result().color.detach().requires_grad_()
            for threads in options.threads:
                use_threads(threads)
                yardstick = None
                if limit is not None:
                    limit.L.omp_set_num_threads(threads)
                    yardstick = limit.LimitKernel(raw, view)
                passes: list[tuple[str, Call, Call | None]] = [
                    ("forward", ours.forward, yardstick and yardstick.forward),
                    ("forward_backward", ours.both, yardstick and (lambda y=yardstick, t=target: y.fwd_bwd(t))),
                    ("forward_backward_depth", ours.both_with_depth, None),
                    ("photometric_gradient", lambda i=image, o=ours: photometric(i, o.target, 0.2).backward(), None),
                ]
                if options.oracle:
                    oracle = Ours(raw, view, torch.from_numpy(target), reference.rasterize)
                    passes.append(("oracle_forward_backward", oracle.both, None))
                for name, call, other in passes:
                    calls = {"ours": call} | ({} if other is None else {"yardstick": other})
                    times = in_turn(1 if name.startswith("oracle") else options.rounds, calls)
                    medians = {who: statistics.median(values) for who, values in times.items()}
                    ratio = medians["ours"] / medians["yardstick"] if "yardstick" in medians else None
                    memory = peak_mb(options.yardstick, count, size) if name == "forward_backward" else None
                    cells = [
                        f"{medians[who]:.1f} ({min(times[who]):.1f})" if who in times else ""
                        for who in ("ours", "yardstick")
                    ]
                    print(
                        f"{count // 1000:>4}k/{size:<4} {threads:>3}  {name:<26} {cells[0]:>15}  {cells[1]:>15}  "
                        f"{'' if ratio is None else f'{ratio:.2f}':>6}  {'' if memory is None else f'{memory:.0f}':>7}",
                        flush=True,
                    )
                    rows.append(
                        {
                            "n": count, "px": size, "pass": name, "threads": threads, "ours_ms": medians["ours"],
                            "yardstick_ms": medians.get("yardstick"), "ratio": ratio, "peak_mb": memory,
                            "isa": kernel.active_isa(),
                        }
                    )  # fmt: skip
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
