"""Time of the parts of a training step, on a run folder that has a checkpoint.

    python benchmarks/training_step.py RUN [--steps 50] [--threads 2] [--batch 1]

Continues the run in memory (nothing is written) and measures each part of a step separately. Drawing, loss and backward
pass run view by view, whereas a real step draws all views first. The last lines are the time of `Trainer.step` itself
with the networks' products in float32 and, where the CPU has AMX, in bfloat16: blocks of steps of both
in turn.
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
from graings.scene.perceptron import bfloat16_products
from graings.training.guard.guard import Gradient
from graings.training.run import TrainingRun
from graings.training.trainer import Trainer

BLOCKS = 4  # of steps with the same precision


class Stopwatch:
    """Milliseconds by name, one list entry per step; laps of the same name within a step add up."""

    def __init__(self) -> None:
        self.parts: dict[str, list[float]] = defaultdict(list)
        self._step: dict[str, float] = defaultdict(float)
        self._last = time.perf_counter()

    def start(self) -> None:
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self._step[name] += 1e3 * (now - self._last)
        self._last = now

    def close(self) -> None:
        """Ends a step."""
        for name, milliseconds in self._step.items():
            self.parts[name].append(milliseconds)
        self._step.clear()


def measured_step(trainer: Trainer, watch: Stopwatch) -> int:
    """One step, part by part; returns the number of Gaussians drawn."""
    trainer.iteration += 1
    trainer.scene.temporal = trainer.phase(trainer.iteration).temporal
    frames = trainer.views.next(trainer.iteration)
    watch.start()
    targets = [torch.from_numpy(trainer.images.rgb(frame)) for frame in frames]
    for view in trainer.views.upcoming(trainer.iteration):
        trainer.images.prefetch(trainer.pyramid.at(trainer.iteration + 1).frames[view])
    watch.lap("images")
    with bfloat16_products(trainer.rounds_products):
        compositions = trainer.scene.compose_together([(frame.camera.center, frame.time) for frame in frames])
    watch.lap("scene forward")
    leaves, grads, screen = [], [], []
    for frame, target, composition in zip(frames, targets, compositions, strict=True):
        gaussians = composition.gaussians
        watch.start()
        offset = torch.zeros(len(gaussians), 2, requires_grad=True)
        result = draw(composition, frame.camera, trainer.background, means2d_offset=offset)
        watch.lap("raster forward")
        image = result.color.detach().requires_grad_()
        (photometric(image, target, trainer.config.loss.ssim) / len(frames)).backward()
        watch.lap("photometric loss, forward + backward")
        own = [gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacities, gaussians.colors]
        *raster_gradients, at_centres = torch.autograd.grad(result.color, [*own, offset], image.grad)
        watch.lap("raster backward")
        leaves += own
        grads += raster_gradients
        screen.append((at_centres, result.radii.amax(-1) > 0))
    with bfloat16_products(trainer.rounds_products):
        regulariser = trainer.objective.regularisers(trainer.scene, compositions, [frame.time for frame in frames])
    watch.lap("regularisers forward (a second time of DeformNet)")
    torch.autograd.backward(
        [*leaves, *([regulariser] if regulariser.requires_grad else [])],
        [*grads, *([torch.ones(())] if regulariser.requires_grad else [])],
    )
    watch.lap("scene backward")
    gradients = trainer.optimizer.gradients()
    gradients += [Gradient("the projected centres", "screen", at_centres) for at_centres, _ in screen]
    trainer.guard.check_step(trainer.iteration, regulariser.detach(), gradients)
    watch.lap("guard")
    for frame, composition, (at_centres, visible) in zip(frames, compositions, screen, strict=True):
        size = (frame.camera.width, frame.camera.height)
        trainer.density.statistics.observe(
            composition.children, at_centres * len(frames), visible, composition.opacities, size
        )
    watch.lap("growth statistics")
    trainer.optimizer.step(trainer.iteration)
    watch.lap("optimizer")
    watch.close()
    return len(compositions[0].children)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--batch", type=int, default=None, help="views per step; left out: as the run has it")
    arguments = parser.parse_args()
    run = TrainingRun.resume(arguments.run, threads=arguments.threads)
    with kernel.computing_threads(run.threads):
        measure(run, arguments.steps, arguments.batch)


def measure(run: TrainingRun, steps: int, batch: int | None) -> None:
    """Print the milliseconds of the parts of a step, and of a whole one."""
    trainer = run._trainer
    if batch is not None:
        trainer.config = trainer.config.model_copy(update={"batch": batch})
    trainer.iteration = min(trainer.iteration, run.iterations - 3 * steps - 20)
    for _ in range(5):
        trainer.step()
    watch = Stopwatch()
    counts = [measured_step(trainer, watch) for _ in range(steps)]
    before = trainer.rounds_products
    whole: dict[bool, list[float]] = {False: []} | ({True: []} if kernel.has_bfloat16_products() else {})
    for trainer.rounds_products in [*whole] * BLOCKS:
        trainer.step()  # allocates memory for activations of the other size
        for _ in range(steps // BLOCKS):
            started = time.perf_counter()
            trainer.step()
            whole[trainer.rounds_products].append(1e3 * (time.perf_counter() - started))
    trainer.rounds_products = before
    camera = run.capture.train[0].camera
    print(
        f"{camera.width}x{camera.height} px, iteration {trainer.iteration}, {statistics.median(counts):.0f} drawn, "
        f"{trainer.scene.scaffold.count} anchors, "
        f"{trainer.config.batch} views a step, {kernel.thread_count()} threads, median of {steps} steps"
    )
    total = 0.0
    for name, values in watch.parts.items():
        median = statistics.median(values)
        total += median
        print(f"{median:8.2f} ms  {name}")
    print(f"{total:8.2f} ms  sum of the parts")
    for rounded, values in whole.items():
        precision = "bfloat16" if rounded else "float32"
        print(f"{statistics.median(values):8.2f} ms  Trainer.step, products of networks in {precision}")


if __name__ == "__main__":
    main()
