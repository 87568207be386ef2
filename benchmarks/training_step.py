"""Where one training step goes: milliseconds per part, on a run folder that has a checkpoint.

    python benchmarks/training_step.py RUN [--steps 50] [--threads 2]

Continues the run in memory (nothing is written) and measures each part of a step apart; the parts are timed
in the order of a real step, and the last line compares their sum with the unbroken `Trainer.step`.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import defaultdict
from pathlib import Path

import torch

from graings import kernel
from graings.raster.photometric import photometric
from graings.render import draw
from graings.training.guard import Gradient
from graings.training.run import TrainingRun
from graings.training.trainer import Trainer


class Stopwatch:
    """Milliseconds by name, one list entry per step."""

    def __init__(self) -> None:
        self.parts: dict[str, list[float]] = defaultdict(list)
        self._last = time.perf_counter()

    def start(self) -> None:
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.parts[name].append(1e3 * (now - self._last))
        self._last = now


def measured_step(trainer: Trainer, watch: Stopwatch) -> int:
    """One step taken apart; returns the number of Gaussians drawn."""
    trainer.iteration += 1
    trainer.scene.temporal = trainer.phase(trainer.iteration).temporal
    frame = trainer.capture.train[trainer.sampler.next()]
    watch.start()
    target = torch.from_numpy(trainer.images.rgb(frame))
    watch.lap("image")
    composition = trainer.scene.compose(frame.camera.center, frame.time)
    watch.lap("scene forward")
    gaussians = composition.gaussians
    offset = torch.zeros(len(gaussians), 2, requires_grad=True)
    result = draw(composition, frame.camera, trainer.background, means2d_offset=offset)
    watch.lap("raster forward")
    image = result.color.detach().requires_grad_()
    photometric(image, target, trainer.config.loss.ssim).backward()
    watch.lap("photometric loss, forward + backward")
    leaves = [gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacities, gaussians.colors, offset]
    grads = torch.autograd.grad(result.color, leaves, image.grad)
    watch.lap("raster backward")
    regulariser = trainer.regularisers(composition, frame.time)
    watch.lap("regularisers forward (a second time of DeformNet)")
    torch.autograd.backward(
        [*leaves[:-1], *([regulariser] if regulariser.requires_grad else [])],
        [*grads[:-1], *([torch.ones(())] if regulariser.requires_grad else [])],
    )
    watch.lap("scene backward")
    gradients = [*trainer.optimizer.gradients(), Gradient("the projected centres", "screen", grads[-1])]
    trainer.guard.judge(trainer.iteration, regulariser.detach(), gradients)
    watch.lap("guard")
    size = (frame.camera.width, frame.camera.height)
    visible = result.radii.amax(-1) > 0
    trainer.density.statistics.observe(composition.children, grads[-1], visible, composition.opacities, size)
    watch.lap("growth statistics")
    trainer.optimizer.step(trainer.iteration)
    watch.lap("optimizer")
    return len(gaussians)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--threads", type=int, default=None)
    arguments = parser.parse_args()
    run = TrainingRun.resume(arguments.run, threads=arguments.threads)
    trainer = run._trainer
    trainer.iteration = min(trainer.iteration, run.iterations - 2 * arguments.steps - 10)
    for _ in range(5):
        trainer.step()
    watch = Stopwatch()
    counts = [measured_step(trainer, watch) for _ in range(arguments.steps)]
    whole = []
    for _ in range(arguments.steps):
        started = time.perf_counter()
        trainer.step()
        whole.append(1e3 * (time.perf_counter() - started))
    camera = run.capture.train[0].camera
    print(
        f"{camera.width}x{camera.height} px, iteration {trainer.iteration}, {statistics.median(counts):.0f} drawn, "
        f"{trainer.scene.scaffold.count} anchors, {kernel.threads()} threads, median of {arguments.steps} steps"
    )
    total = 0.0
    for name, values in watch.parts.items():
        median = statistics.median(values)
        total += median
        print(f"{median:8.2f} ms  {name}")
    print(f"{total:8.2f} ms  sum of the parts")
    print(f"{statistics.median(whole):8.2f} ms  Trainer.step, unbroken")


if __name__ == "__main__":
    main()
