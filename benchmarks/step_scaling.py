"""How the time of a training step scales with Gaussians and with pixels.

    python benchmarks/step_scaling.py RUN -o FOLDER [--threads 2] [--steps 40]

Continues RUN (a folder with a checkpoint) in memory; nothing in it is written. Fewer Gaussians are a random share of
its anchors, other sizes the same capture loaded again, so the largest useful size is that of its files. Writes
FOLDER/step_scaling.{json,svg} and prints median milliseconds and the slope of log time against log size: 1 is linear, 0
is constant. A step has the batch of the run. The parts are those of training_step.py.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any

import torch
from scaling import write_scaling
from training_step import Stopwatch, measured_step

from graings import kernel
from graings.capture.load import load_capture
from graings.training.curriculum.image_pyramid import ImagePyramid
from graings.training.parameter_average import ParameterAverage
from graings.training.run import TrainingRun
from graings.training.trainer import Trainer

FRACTIONS = (1.0, 0.5, 0.25, 0.125, 0.0625)
SIDES = (100, 200, 400, 800)


def milliseconds(trainer: Trainer, steps: int) -> tuple[int, dict[str, float]]:
    """(Gaussians drawn, median milliseconds by part)."""
    for _ in range(5):
        trainer.step()
    watch = Stopwatch()
    drawn = [measured_step(trainer, watch) for _ in range(steps)]
    return round(statistics.median(drawn)), {name: statistics.median(all_) for name, all_ in watch.parts.items()}


def trainer_of(options: argparse.Namespace, share: float, side: int | None) -> Trainer:
    """A trainer of the run with that share of its anchors, on images of that size (None: the run's own)."""
    run = TrainingRun.resume(options.run, threads=options.threads)
    trainer: Trainer = run._trainer
    # A phase without growth and pruning.
    trainer.iteration = min(trainer.iteration, run.iterations - options.steps - 10)
    if side is not None:
        trainer.capture = load_capture(run.capture.root, run.config.capture.model_copy(update={"max_side": side}))
        trainer.pyramid = ImagePyramid(trainer.config, trainer.capture.train, float(trainer.scene.extent))
    if share < 1:
        count = trainer.scene.scaffold.count
        keep = torch.rand(count, generator=torch.Generator().manual_seed(0)) < share
        trainer.optimizer.keep(keep)
        trainer.density.statistics.resize(keep=keep)
        trainer.average = ParameterAverage()  # that of the checkpoint covers all anchors
    return trainer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--steps", type=int, default=40)
    options = parser.parse_args()
    with kernel.computing_threads(options.threads):
        write_scaling(options.output, "step_scaling", measured(options))


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """The document of the measurements."""
    by_count = dict(milliseconds(trainer_of(options, share, None), options.steps) for share in FRACTIONS)
    by_pixels: dict[int, dict[str, float]] = {}
    for side in SIDES:
        trainer = trainer_of(options, 1.0, side)
        camera = trainer.capture.train[0].camera
        by_pixels[camera.width * camera.height] = milliseconds(trainer, options.steps)[1]
    views = trainer.config.batch
    series = {"Gaussians drawn": by_count, "pixels of an image": by_pixels}
    return {
        "title": f"What one training step of {views} views costs",
        "isa": kernel.active_isa(),
        "threads": kernel.thread_count(),
        "views": views,
        "series": {title: {str(size): row for size, row in rows.items()} for title, rows in series.items()},
    }


if __name__ == "__main__":
    main()
