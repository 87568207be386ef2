"""A trainer small enough for hundreds of steps in a test, and ways to spoil one of its steps."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import TrainConfig, make_config
from graings.evaluation.evaluate import evaluate
from graings.kernel import use_threads
from graings.raster.photometric import photometric
from graings.render import draw
from graings.scene.scene import Scene
from graings.training import objective as objective_module
from graings.training.optimizer import Optimizer
from graings.training.step_report import StepReport
from graings.training.trainer import Trainer

# Nothing grows or goes unless a test wants it: parameters keep their identity.
STILL = {"density.grow_from": 30_000, "density.grow_until": 0, "density.prune_from": 30_000, "density.prune_until": 0}

# Where anchors are to be born: from the first tenth to the half of the run.
GROWING = {
    "density.statistics_from": 0,
    "density.grow_from": 3_000,
    "density.grow_until": 15_000,
    "density.grow_every": 20,
}


def micro_config(**overrides: object) -> TrainConfig:
    small: dict[str, object] = {
        "iterations": 200,
        "threads": 1,
        "batch": 1,  # who spoils one view spoils one step
        "warmup": 3_000,
        "init.points": 150,
        "scene.children": 3,
        "scene.feature_dim": 8,
        "scene.deform_width": 16,
        "scene.deform_depth": 2,
        "density.min_observations": 2,
        "evaluation.first": 20,
        "evaluation.views": 2,
        "guard.snapshot_every": 25,
        "guard.check_every": 5,
    }
    return make_config("draft", small | STILL | overrides)


def micro_trainer(capture: Path, **overrides: object) -> Trainer:
    config = micro_config(**overrides)
    use_threads(1)
    data = load_capture(capture, config.capture)
    images = ImageStore(config.capture.background_rgb(), config.capture.cache_mb)
    return Trainer.start(data, images, config)


def steps(trainer: Trainer, count: int) -> list[StepReport]:
    return [trainer.step() for _ in range(count)]


def plain_training(trainer: Trainer, dtype: torch.dtype, count: int) -> tuple[Scene, list[float]]:
    """`count` steps of a copy of the trainer's scene in one precision: views in order, the photometric loss alone.

    Returns the trained scene and the loss of every step.
    """
    scene = copy.deepcopy(trainer.scene).to(dtype)
    scene.temporal = True
    optimizer = Optimizer(scene, trainer.config, joint_from=0)
    found = []
    for iteration in range(1, count + 1):
        frame = trainer.capture.train[iteration % len(trainer.capture.train)]
        target = torch.from_numpy(trainer.images.rgb(frame)).to(dtype)
        drawn = draw(scene.compose(frame.camera.center, frame.time), frame.camera, trainer.background)
        loss = photometric(drawn.color, target, 0.2)
        loss.backward()
        optimizer.step(iteration)
        found.append(float(loss.detach()))
    return scene, found


def events_of(reports: list[StepReport], kind: str | None = None) -> list[Any]:
    """Events of this kind, or all."""
    return [event for report in reports for event in report.events if kind in (None, event.kind)]


def quality(trainer: Trainer) -> float:
    """PSNR over all training views in dB."""
    psnr = evaluate(trainer.scene, trainer.capture.train, trainer.images, trainer.background).psnr
    assert psnr is not None
    return psnr


def finite(trainer: Trainer) -> bool:
    tensors = [*trainer.scene.parameters(), *trainer.optimizer.state().values()]
    return all(bool(tensor.isfinite().all()) for tensor in tensors)


def spoil_gradient(
    trainer: Trainer, name: str, when: Callable[[int], bool], change: Callable[[Tensor], Tensor]
) -> None:
    """Have `change` make the gradient of parameter `name` in the steps that `when` chooses."""
    parameter = dict(trainer.scene.named_parameters())[name]
    parameter.register_hook(lambda gradient: change(gradient.clone()) if when(trainer.iteration) else gradient)


def spoil_loss(
    monkeypatch: pytest.MonkeyPatch, trainer: Trainer, when: Callable[[int], bool], factor: float = float("nan")
) -> None:
    """Multiply the photometric loss by `factor` in the steps that `when` chooses."""
    true = objective_module.photometric

    def spoiled(image: Tensor, target: Tensor, *weights: float, valid: Tensor | None = None) -> Tensor:
        value = true(image, target, *weights, valid=valid)
        return value * factor if when(trainer.iteration) else value

    monkeypatch.setattr(objective_module, "photometric", spoiled)


def first(values: Tensor, number: float) -> Tensor:
    """`values` with `number` in place of its first entry."""
    values.view(-1)[0] = number
    return values


def everywhere(number: float) -> Callable[[Tensor], Tensor]:
    """Replaces a gradient by one number."""
    return lambda gradient: torch.full_like(gradient, number)
