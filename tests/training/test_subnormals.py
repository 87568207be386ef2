"""Subnormal numbers in the optimiser: none stays, no parameter moves differently, and the CPU's mode is restored."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from graings.config import TrainConfig
from graings.training.optimizer import ADAM_EPSILON, Optimizer
from graings.training.subnormals import flushed_subnormals, subnormals_are_flushed
from tests.models import tiny_scene

SMALLEST_NORMAL = torch.finfo(torch.float32).tiny


@pytest.fixture(autouse=True)
def keeping_subnormals() -> Iterator[None]:
    supported = torch.set_flush_denormal(True)
    torch.set_flush_denormal(False)
    if not supported:
        pytest.skip("this CPU cannot flush subnormal numbers")
    yield
    torch.set_flush_denormal(False)


def test_moments_without_gradients_become_zero_and_parameters_are_those_of_plain_adam() -> None:
    scene = tiny_scene()
    optimizer = Optimizer(scene, TrainConfig(iterations=2_000), joint_from=0)
    features = scene.scaffold.features
    plain = torch.nn.Parameter(features.detach().clone())
    reference = torch.optim.Adam([plain], eps=ADAM_EPSILON, fused=True)
    seen = torch.randn(features.shape, generator=torch.Generator().manual_seed(0)) * 1e-3
    hidden = torch.zeros_like(seen)
    for iteration in range(1, 1_201):
        # The first anchor is seen in every step, the others in the first step only.
        gradient = seen if iteration == 1 else torch.cat([seen[:1], hidden[1:]])
        features.grad, plain.grad = gradient.clone(), gradient.clone()
        reference.param_groups[0]["lr"] = optimizer.rate("features", iteration)
        optimizer.step(iteration)
        reference.step()
    moments = optimizer.adam.state[features]
    assert torch.equal(features, plain)
    assert 0 < reference.state[plain]["exp_avg"][1:].abs().amax() < SMALLEST_NORMAL
    assert not moments["exp_avg"][1:].any()
    assert torch.equal(moments["exp_avg_sq"], reference.state[plain]["exp_avg_sq"])


@pytest.mark.parametrize("before", [False, True])
def test_the_mode_of_the_cpu_is_restored(before: bool) -> None:
    torch.set_flush_denormal(before)
    with pytest.raises(ZeroDivisionError), flushed_subnormals():
        1 / (not subnormals_are_flushed())  # raises where they are flushed
    assert subnormals_are_flushed() == before
