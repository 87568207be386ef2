"""Muon against torch's own, and where singular values have no business to be."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from graings.config import TrainConfig
from graings.training.muon import ITERATIONS, Muon, orthogonal
from graings.training.optimizer import Optimizer
from tests.models import tiny_scene

# Three products in each iteration, each rounded to the 8 digits of bfloat16.
BFLOAT16 = 3 * ITERATIONS * 2.0**-9

SHAPES = ((64, 39), (64, 64), (13, 64), (5, 1))


def _matrices(seed: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(shape, generator=generator) for shape in SHAPES]


def test_steps_are_those_of_torch_to_the_digits_of_its_bfloat16() -> None:
    ours, theirs = ([nn.Parameter(matrix) for matrix in _matrices(0)] for _ in range(2))
    muon = Muon(ours)
    oracle = torch.optim.Muon(theirs, lr=1e-3, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
    for seed in range(1, 21):
        for a, b, gradient in zip(ours, theirs, _matrices(seed), strict=True):
            a.grad, b.grad = gradient, gradient.clone()
        muon.step([1e-3] * len(SHAPES))
        oracle.step()
    for a, b, start in zip(ours, theirs, _matrices(0), strict=True):
        ours_moved, theirs_moved = a.detach() - start, b.detach() - start
        assert float((ours_moved - theirs_moved).norm()) < BFLOAT16 * float(theirs_moved.norm())


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e30])
def test_singular_values_end_near_one_whatever_the_size(scale: float) -> None:
    matrices = [scale * matrix for matrix in _matrices(0)]
    for matrix in matrices:
        even = orthogonal(matrix)
        left, values, right = torch.linalg.svd(matrix.double(), full_matrices=False)
        along = (left.mT @ even.double() @ right.mT).diagonal()[values > 0.01 * values[0]]
        assert float(along.min()) > 0.6
        assert float(along.max()) < 1.25


def test_a_rare_direction_moves_as_far_as_a_common_one() -> None:
    left, right = (torch.linalg.qr(torch.randn(8, 8, generator=torch.Generator().manual_seed(i)))[0] for i in (0, 1))
    uneven = left @ torch.diag(torch.logspace(0, -1.5, 8)) @ right
    even = orthogonal(uneven)
    along = (left.mT @ even @ right.mT).diagonal()
    assert float(along.min()) > 0.6
    assert float(along.max()) < 1.25


def test_a_rare_direction_among_as_many_as_the_largest_layer_has_moves_two_fifths_as_far() -> None:
    left, right = (
        torch.linalg.qr(torch.randn(128, 128, generator=torch.Generator().manual_seed(i)))[0] for i in (0, 1)
    )
    values = torch.ones(128)
    values[-1] = 0.011
    along = (left.mT @ orthogonal(left @ torch.diag(values) @ right.mT) @ right).diagonal()
    assert float(along.min()) > 0.4
    assert float(along.max()) < 1.25


def test_a_zero_matrix_stays_zero() -> None:
    parameter = nn.Parameter(torch.ones(4, 3))
    muon = Muon([parameter])
    muon.step([0.1])  # no gradient yet
    parameter.grad = torch.zeros(4, 3)
    muon.step([0.1])
    assert torch.equal(parameter.detach(), torch.ones(4, 3))


def test_vectors_are_refused() -> None:
    with pytest.raises(ValueError, match="matrices"):
        Muon([nn.Parameter(torch.ones(3))])


def test_matrices_of_geometry_are_its_own_and_all_else_is_adams() -> None:
    scene = tiny_scene()
    optimizer = Optimizer(scene, TrainConfig(), joint_from=0)
    owned = {id(parameter) for parameter in optimizer.muon.parameters}
    found = {name.removesuffix(".weight") for name, parameter in scene.named_parameters() if id(parameter) in owned}
    moving = {"from_position", "hidden.0", "psi.0", "psi.2"}
    assert found == {f"deformation.{name}" for name in moving} | {"static.from_feature", "static.from_offset"}
    others = {id(p) for group in optimizer.adam.param_groups for p in group["params"]}
    assert owned.isdisjoint(others)
    assert len(owned) + len(others) == len(list(scene.parameters()))


def test_adam_steps_everything_if_configured() -> None:
    assert Optimizer(tiny_scene(), TrainConfig(matrix_optimizer="adam"), joint_from=0).muon.parameters == []


def test_momenta_are_restored_by_name() -> None:
    scene = tiny_scene()
    optimizer = Optimizer(scene, TrainConfig(), joint_from=0)
    for number, momentum in enumerate(optimizer.muon.momenta):
        momentum.fill_(number + 1.0)
    state = optimizer.state()
    again = Optimizer(scene, TrainConfig(), joint_from=0)
    again.load(state)
    assert all(torch.equal(a, b) for a, b in zip(again.muon.momenta, optimizer.muon.momenta, strict=True))
    assert again.adam.state == {}


def test_tiny_entries_count_as_zero_and_leave_no_subnormal_numbers() -> None:
    """A unit that nothing wakes leaves momentum that fades for ever; subnormal numbers are slow on some CPUs."""
    matrix = torch.randn(64, 64, generator=torch.Generator().manual_seed(0))
    without = matrix.clone()
    matrix[3::7] *= torch.logspace(-9, -42, 9).unsqueeze(-1) * 0.1
    without[3::7] = 0
    even = orthogonal(matrix)
    assert torch.equal(even, orthogonal(without))
    tiny = torch.finfo(torch.float32).tiny
    assert not bool(((even != 0) & (even.abs() < tiny)).any())
