"""Times the rasterizer and a reference implementation ("yardstick"), forward and forward + backward.

    python benchmarks/rasterize.py --yardstick DIR [--gaussians 10000 50000 200000] [--splat FILE] [--run RUN]
                                   [--size 400 800] [--threads 1 2] [--rounds 8] [--json FILE] [--oracle]

DIR holds `bench_scene.py` with `make_scene(n)`, `camera(size, dist=...)` and `target_image(height, width)`, and
optionally `limit_kernel.py` with a class `LimitKernel(scene, camera)` that has `forward()` and `fwd_bwd(target)`: the
yardstick, built when first used. Further scenes: splat files and run folders of trained models. Our time includes the
PyTorch function with its argument checks; it computes colour and alpha, and depth in the rows that name it. Both use
the sign of the difference to the target as upstream gradient.

The two are timed alternately, so that other load affects both: a pause, a warm-up call, three measured calls. The
yardstick runs in its own process, because both would otherwise share the threads of one OpenMP library, which keep a
core busy long after a call.

Prints median (minimum) in ms, the ratio of the medians, and the memory that one forward + backward takes at its peak
beyond its inputs, images and gradients included, in a fresh process.
`backward_given` is forward + backward with a precomputed upstream gradient: only work that threads share; memory is
measured with it.
`--oracle` adds the plain torch oracle (slow).
"""

from __future__ import annotations

import argparse
import ctypes
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import scenes
import torch
from torch import Tensor

from graings import kernel
from graings.camera.camera import Camera
from graings.gaussians import Gaussians
from graings.kernel import use_threads
from graings.raster import reference
from graings.raster.photometric import photometric
from graings.raster.rasterize import rasterize
from graings.raster.result import RenderResult

PAUSE = 0.04  # s; OpenMP threads spin for about 10 ms after a call
REPEATS = 3
Milliseconds = Callable[[], float]


class Ours:
    """One scene drawn by one of our rasterizers."""

    def __init__(self, scene: scenes.Scene, draw: Callable[..., RenderResult] = rasterize) -> None:
        arrays, view = scene.arrays, scene.view
        leaves = {name: torch.from_numpy(arrays[name]) for name in ("means", "quats", "opacities", "colors")}
        leaves["log_scales"] = torch.from_numpy(arrays["scales"]).log()
        self.leaves = {name: leaf.requires_grad_() for name, leaf in leaves.items()}
        self.gaussians = Gaussians(**self.leaves, uids=torch.arange(len(arrays["means"])))
        self.camera = Camera(view["viewmat"], view["fx"], view["fy"], view["cx"], view["cy"], view["W"], view["H"])
        self.background = torch.zeros(3)
        self.target = torch.from_numpy(scene.target)
        self.draw = draw
        self.image = self.result().color.detach()
        self.given = self.upstream(self.image)

    def result(self, *, depth: bool = False) -> RenderResult:
        return self.draw(self.gaussians, self.camera, self.background, depth=depth)

    def forward(self) -> None:
        with torch.no_grad():
            self.result()

    def forward_backward(self) -> None:
        color = self.result().color
        torch.autograd.grad(color, list(self.leaves.values()), self.upstream(color))

    def backward_given(self) -> None:
        torch.autograd.grad(self.result().color, list(self.leaves.values()), self.given)

    def forward_backward_depth(self) -> None:
        result = self.result(depth=True)
        upstream = self.upstream(result.color)
        extra = upstream[..., 0].contiguous()
        torch.autograd.grad(
            [result.color, result.alpha, result.depth], list(self.leaves.values()), [upstream, extra, extra]
        )

    def photometric_gradient(self) -> None:
        photometric(self.image.requires_grad_(), self.target, 0.2).backward()

    def upstream(self, color: Tensor) -> Tensor:
        return (color.detach() - self.target).sign_().div_(self.target.numel())

    def timed(self, name: str) -> Milliseconds:
        call = getattr(self, name)

        def milliseconds() -> float:
            start = time.perf_counter()
            call()
            return 1e3 * (time.perf_counter() - start)

        return milliseconds


class Yardstick:
    """The yardstick on one scene, in its own process."""

    def __init__(self, folder: Path, name: str, threads: int) -> None:
        command = [sys.executable, __file__, "--yardstick", str(folder), "--serve", name, str(threads)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.ask("forward")

    def ask(self, name: str) -> float:
        """Milliseconds of one call in that process."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(name + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError(f"the yardstick ended with code {self.process.wait()}")
        return float(answer)

    def timed(self, name: str) -> Milliseconds:
        return lambda: self.ask(name)

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def serve(folder: Path, name: str, threads: int) -> None:
    """The server loop in the process of `Yardstick`."""
    limit = scenes.module_of(folder, "limit_kernel")
    assert limit is not None
    limit.L.omp_set_num_threads(threads)
    scene = scenes.named(name, folder)
    kernel_ = limit.LimitKernel(scene.arrays, scene.view)
    calls = {"forward": kernel_.forward, "forward_backward": lambda: kernel_.fwd_bwd(scene.target)}
    for line in sys.stdin:
        start = time.perf_counter()
        calls[line.strip()]()
        print(1e3 * (time.perf_counter() - start), flush=True)


def in_turn(rounds: int, calls: dict[str, Milliseconds]) -> dict[str, list[float]]:
    """Milliseconds of each call, without the first round."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        for name, call in calls.items():
            time.sleep(PAUSE)
            values = [call() for _ in range(1 + REPEATS)][1:]
            if turn > 0:
                times[name] += values
    return times


def peak_mb(folder: Path, name: str) -> float:
    """Peak resident memory of one forward + backward beyond its inputs, in MB, measured in its own process."""
    command = [sys.executable, __file__, "--yardstick", str(folder), "--measure-memory", name]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def measure_memory(folder: Path, name: str) -> float:
    """The measurement in the process of `peak_mb`."""
    scene = scenes.named(name, folder)
    ours = Ours(scene)
    del ours.image
    Ours(scenes.named("100/16", folder)).forward_backward()  # loads the libraries
    if hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)  # freed memory could be reused without being counted
    before = _status_kb("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    ours.backward_given()
    return (_status_kb("VmHWM") - before) / 1000


def _status_kb(field: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(field)).split()[1])


def measured(name: str, threads: int, options: argparse.Namespace) -> list[dict[str, object]]:
    """One row per pass; each is printed when it is complete."""
    scene = scenes.named(name, options.yardstick)
    use_threads(threads)
    ours = Ours(scene)
    yardstick = None
    if scenes.module_of(options.yardstick, "limit_kernel") is not None:
        yardstick = Yardstick(options.yardstick, name, threads)
    rows: list[dict[str, object]] = []
    passes = ["forward", "forward_backward", "backward_given", "forward_backward_depth", "photometric_gradient"]
    for part in passes + ["oracle"] * options.oracle:
        calls = {"ours": ours.timed(part) if part != "oracle" else Ours(scene, reference.rasterize).timed(passes[1])}
        if yardstick is not None and part in ("forward", "forward_backward"):
            calls["yardstick"] = yardstick.timed(part)
        times = in_turn(1 if part == "oracle" else options.rounds, calls)
        median = {who: statistics.median(values) for who, values in times.items()}
        ratio = median["ours"] / median["yardstick"] if "yardstick" in median else None
        memory = peak_mb(options.yardstick, name) if part == "forward_backward" else None
        cells = [f"{median[who]:.1f} ({min(times[who]):.1f})" if who in times else "" for who in ("ours", "yardstick")]
        label = f"{Path(name.rsplit('/', 1)[0]).stem}/{scene.view['W']}"
        print(
            f"{label:>24} {threads:>3}  {part:<22} {cells[0]:>15}  {cells[1]:>15}  "
            f"{'' if ratio is None else f'{ratio:.2f}':>6}  {'' if memory is None else f'{memory:.0f}':>7}",
            flush=True,
        )
        rows.append(
            {
                "scene": label, "n": len(scene.arrays["means"]), "px": scene.view["W"], "pass": part,
                "threads": threads, "ours_ms": median["ours"], "yardstick_ms": median.get("yardstick"),
                "ratio": ratio, "peak_mb": memory, "isa": kernel.active_isa(),
            }
        )  # fmt: skip
    if yardstick is not None:
        yardstick.close()
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--yardstick", type=Path, required=True)
    parser.add_argument("--gaussians", type=int, nargs="*", default=[10_000, 50_000, 200_000])
    parser.add_argument("--splat", type=Path, nargs="*", default=[])
    parser.add_argument("--run", type=Path, nargs="*", default=[])
    parser.add_argument("--size", type=int, nargs="+", default=[400, 800])
    parser.add_argument("--threads", type=int, nargs="+", default=[kernel.usable_cores()])
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--oracle", action="store_true")
    parser.add_argument("--measure-memory", help=argparse.SUPPRESS)
    parser.add_argument("--serve", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure_memory is not None:
        print(measure_memory(options.yardstick, options.measure_memory))
        return
    if options.serve is not None:
        serve(options.yardstick, options.serve[0], int(options.serve[1]))
        return
    if scenes.module_of(options.yardstick, "bench_scene") is None:
        parser.error(f"{options.yardstick / 'bench_scene.py'} not found: give its folder with --yardstick")
    print(f"{kernel.active_isa()}, median (minimum) of {REPEATS * options.rounds} in ms")
    print(f"{'scene':>24} {'thr':>3}  {'pass':<22} {'ours':>15}  {'yardstick':>15}  {'ratio':>6}  {'peak MB':>7}")
    rows = []
    for name in scenes.names(options.gaussians, options.size, options.splat, options.run):
        for threads in options.threads:
            rows += measured(name, threads, options)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
