"""The mean that a training ends with."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch

from graings.training.parameter_average import ParameterAverage
from graings.training.trainer import Trainer
from tests.models import tiny_scene
from tests.training.micro import micro_trainer, steps

HALF = {"iterations": 40, "average_from": 15_000}  # the last twenty


def _parameters(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {name: parameter.detach().clone() for name, parameter in trainer.scene.named_parameters()}


def test_training_ends_with_the_mean_of_its_last_steps(micro: Path) -> None:
    plain = micro_trainer(micro, **HALF | {"average_from": 30_000})
    steps(plain, 20)
    seen = []
    for _ in range(20):
        plain.step()
        seen.append(_parameters(plain))
    averaged = micro_trainer(micro, **HALF)
    steps(averaged, 40)
    for name, mean in _parameters(averaged).items():
        values = torch.stack([parameters[name] for parameters in seen]).double()
        # One rounding of the mean for each of twenty steps.
        bound = 20 * torch.finfo(torch.float32).eps * values.abs().amax()
        assert float((values.mean(0) - mean).abs().max()) <= float(bound)
    moved = (plain.scene.scaffold.offsets - averaged.scene.scaffold.offsets).detach()
    assert float(moved.abs().max()) > 1e-4


def test_it_is_the_same_after_an_interruption_among_them(micro: Path) -> None:
    whole = micro_trainer(micro, **HALF)
    steps(whole, 40)
    first = micro_trainer(micro, **HALF)
    steps(first, 31)
    second = micro_trainer(micro, **HALF)
    second.load(copy.deepcopy(first.scene), *first.state())
    steps(second, 9)
    ended = _parameters(second)
    assert all(torch.equal(ended[name], parameter) for name, parameter in _parameters(whole).items())


@pytest.mark.parametrize("mark", ["density.grow_until", "density.prune_until"])
def test_nothing_is_averaged_while_anchors_may_come_or_go(micro: Path, mark: str) -> None:
    trainer = micro_trainer(micro, **HALF | {mark: 30_000})
    steps(trainer, 40)
    assert trainer.average.steps == 0


def test_a_mean_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="no step was added"):
        ParameterAverage().apply(tiny_scene())
