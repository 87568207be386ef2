"""Non-finite steps are skipped, and three in a row end the run."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from graings.errors import DivergedError
from graings.training.guard import Guard


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_one_bad_entry_of_a_gradient_fails_the_step(bad: float) -> None:
    parameter = nn.Parameter(torch.zeros(100))
    parameter.grad = torch.ones(100)
    guard = Guard()
    assert guard.passes(torch.tensor(1.0), [("p", parameter)])
    parameter.grad[37] = bad
    assert not guard.passes(torch.tensor(1.0), [("p", parameter)])
    assert not guard.passes(torch.tensor(bad), [])
    assert guard.skipped == 2


def test_a_large_finite_gradient_passes() -> None:
    parameter = nn.Parameter(torch.zeros(100))
    parameter.grad = torch.full((100,), 1e30)
    assert Guard().passes(torch.tensor(1.0), [("p", parameter)])


def test_three_bad_steps_in_a_row_end_training_and_a_good_one_forgives() -> None:
    guard, nan, one = Guard(), torch.tensor(float("nan")), torch.tensor(1.0)
    for loss in (nan, nan, one, nan, nan):
        guard.passes(loss, [])
    with pytest.raises(DivergedError, match="the loss"):
        guard.passes(nan, [])
