"""Derivatives of tanh and sigmoid where their values have run out of digits (EXT-E10, E11)."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from graings.scene.saturate import sigmoid, tanh

Function = Callable[[Tensor], Tensor]


@pytest.mark.parametrize(("ours", "torchs"), [(tanh, torch.tanh), (sigmoid, torch.sigmoid)])
def test_values_are_torchs_and_so_are_derivatives_where_those_have_digits(ours: Function, torchs: Function) -> None:
    x = torch.linspace(-4, 4, 101, dtype=torch.float64).requires_grad_()
    assert torch.equal(ours(x), torchs(x))
    (one,) = torch.autograd.grad(ours(x).sum(), x)
    (other,) = torch.autograd.grad(torchs(x).sum(), x)
    assert torch.allclose(one, other, rtol=1e-11, atol=0)


@pytest.mark.parametrize(("function", "slope"), [(tanh, 2.0), (sigmoid, 1.0)])
@pytest.mark.parametrize("at", [-20.0, -9.02, 9.02, 20.0])
def test_a_saturated_value_keeps_its_derivative(function: Function, slope: float, at: float) -> None:
    x = torch.tensor([at], requires_grad=True)
    (found,) = torch.autograd.grad(function(x).sum(), x)
    tail = math.exp(-slope * abs(at))
    assert float(found) == pytest.approx(slope**2 * tail / (1 + tail) ** 2, rel=1e-5)
    assert float(found) > 0


@pytest.mark.parametrize("function", [tanh, sigmoid])
def test_at_infinity_nothing_is_left_and_nan_stays_nan(function: Function) -> None:
    x = torch.tensor([math.inf, -math.inf, math.nan], requires_grad=True)
    (found,) = torch.autograd.grad(function(x).sum(), x)
    assert found[:2].tolist() == [0.0, 0.0]
    assert math.isnan(float(found[2]))


@pytest.mark.parametrize("function", [tanh, sigmoid])
def test_gradcheck_passes(function: Function) -> None:
    x = torch.tensor([-3.0, -0.1, 0.0, 0.7, 5.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(function, x)
