"""Learning-rate schedules and what moves when."""

from __future__ import annotations

import math

import pytest
import torch

from graings.config import TrainConfig
from graings.config.schedule import phases
from graings.training.optimizer import Optimizer
from tests.models import EYE, tiny_scene


def test_rates_run_log_linearly_from_first_to_last() -> None:
    config = TrainConfig(iterations=1000, batch=1)
    optimizer = Optimizer(tiny_scene(), config, joint_from=100)
    first, last = config.rates.offsets
    assert optimizer.rate("offsets", 0) == pytest.approx(first)
    assert optimizer.rate("offsets", 500) == pytest.approx(math.sqrt(first * last))
    assert optimizer.rate("offsets", 1000) == pytest.approx(last)


def test_temporal_rates_start_with_the_joint_phase() -> None:
    config = TrainConfig(iterations=1000, batch=1)
    optimizer = Optimizer(tiny_scene(), config, joint_from=100)
    assert optimizer.rate("deformation", 100) == pytest.approx(config.rates.deformation[0])
    assert optimizer.rate("deformation", 550) == pytest.approx(math.sqrt(math.prod(config.rates.deformation)))


def test_rates_rise_by_the_cube_root_of_the_views_of_a_step() -> None:
    one, eight = (Optimizer(tiny_scene(), TrainConfig(iterations=1000), joint_from=100, views=n) for n in (1, 8))
    for group in ("offsets", "matrices", "color"):
        assert eight.rate(group, 400) == pytest.approx(2 * one.rate(group, 400))


def test_static_step_leaves_temporal_parameters_and_moments_untouched() -> None:
    scene = tiny_scene(temporal=False)
    optimizer = Optimizer(scene, TrainConfig(), joint_from=100)
    frozen = [*scene.deformation.parameters(), *scene.residual.parameters()]
    before = [parameter.detach().clone() for parameter in frozen]
    gaussians = scene.compose(EYE, 0.4).gaussians
    (gaussians.means.sum() + gaussians.colors.sum()).backward()
    optimizer.step(1)
    assert all(torch.equal(a, b) for a, b in zip(before, frozen, strict=True))
    assert all(parameter not in optimizer.adam.state for parameter in frozen)
    assert all(torch.count_nonzero(momentum) == 0 for momentum in optimizer.muon.momenta)


def test_phases_are_data() -> None:
    names = [(phase.name, phase.first, phase.last, phase.temporal) for phase in phases(TrainConfig(iterations=30_000))]
    assert names == [("warmup", 1, 1000, False), ("joint", 1001, 30_000, True)]
    shorter = [(phase.name, phase.last) for phase in phases(TrainConfig(iterations=1000))]
    assert shorter == [("warmup", 33), ("joint", 1000)]
    static = TrainConfig.model_validate({"scene": {"deformation": "none", "residual": False}})
    assert [phase.name for phase in phases(static)] == ["static"]
    without = TrainConfig.model_validate({"scene": {"canonical": False}})
    assert [phase.name for phase in phases(without)] == ["joint"]
