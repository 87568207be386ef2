"""Derivatives of tanh and sigmoid where their values saturate in floating point."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from graings.scene.activations import sigmoid, tanh

Function = Callable[[Tensor], Tensor]


@pytest.mark.parametrize(("ours", "reference"), [(tanh, torch.tanh), (sigmoid, torch.sigmoid)])
def test_values_and_unsaturated_derivatives_are_those_of_torch(ours: Function, reference: Function) -> None:
    x = torch.linspace(-4, 4, 101, dtype=torch.float64).requires_grad_()
    torch.testing.assert_close(ours(x), reference(x), rtol=0, atol=4e-16)
    (derivative,) = torch.autograd.grad(ours(x).sum(), x)
    (expected,) = torch.autograd.grad(reference(x).sum(), x)
    assert torch.allclose(derivative, expected, rtol=1e-11, atol=0)


@pytest.mark.parametrize(("function", "slope"), [(tanh, 2.0), (sigmoid, 1.0)])
@pytest.mark.parametrize("at", [-20.0, -9.02, 9.02, 20.0])
def test_a_saturated_value_keeps_its_derivative(function: Function, slope: float, at: float) -> None:
    x = torch.tensor([at], requires_grad=True)
    (derivative,) = torch.autograd.grad(function(x).sum(), x)
    exponential = math.exp(-slope * abs(at))
    assert float(derivative) == pytest.approx(slope**2 * exponential / (1 + exponential) ** 2, rel=1e-5)
    assert float(derivative) > 0


@pytest.mark.parametrize("function", [tanh, sigmoid])
def test_derivative_is_zero_at_infinity_and_nan_at_nan(function: Function) -> None:
    x = torch.tensor([math.inf, -math.inf, math.nan], requires_grad=True)
    (derivative,) = torch.autograd.grad(function(x).sum(), x)
    assert derivative[:2].tolist() == [0.0, 0.0]
    assert math.isnan(float(derivative[2]))


@pytest.mark.parametrize("function", [tanh, sigmoid])
def test_gradcheck_passes(function: Function) -> None:
    x = torch.tensor([-3.0, -0.1, 0.0, 0.7, 5.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(function, x)
