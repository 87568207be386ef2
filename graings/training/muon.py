"""Muon: momentum whose singular values are made equal, for the weight matrices of networks.

A weight matrix in a deep network gets gradients of few directions; Adam follows those and leaves the rest behind. Here
the momentum's singular vectors keep their place and all its singular values become about 1, so rare directions move as
far as common ones (Jordan et al. 2024, "Muon"; the scale that matches Adam's rates is that of Liu et al. 2025).
`torch.optim.Muon` is the same in bfloat16 and one matrix at a time, which takes eight times as long on a CPU: the
tests use it as the oracle. Knows nothing of scenes, groups or schedules.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor, nn

MOMENTUM: Final = 0.95

# Of the odd quintic x (a + b x^2 + c x^4), which brings singular values from (0, 1] near 1 (Jordan et al.).
QUINTIC: Final = (3.4445, -4.7750, 2.0315)
ITERATIONS: Final = 5

# A matrix whose norm is below this is taken for nothing and moves less: 1e-15, as for Adam, for each of 1 000 entries.
NOTHING: Final = 1e-12

# Root mean square of an Adam update at rate 1, roughly: with it the same rate fits both.
ADAM_RMS: Final = 0.2


class Muon:
    """Steps for weight matrices. `momenta` are the running means of their gradients, in the order of `parameters`."""

    def __init__(self, parameters: Sequence[nn.Parameter]) -> None:
        for parameter in parameters:
            if parameter.ndim != 2:
                raise ValueError(f"Muon steps matrices, got a parameter of shape {tuple(parameter.shape)}")
        self.parameters = list(parameters)
        self.momenta = [torch.zeros_like(parameter) for parameter in parameters]

    @torch.no_grad()
    def step(self, rates: Sequence[float]) -> None:
        """One step of those that have a gradient, at a rate for each; the gradients stay."""
        steps: list[Tensor] = []
        moved: list[tuple[nn.Parameter, float]] = []
        for parameter, momentum, rate in zip(self.parameters, self.momenta, rates, strict=True):
            if parameter.grad is None:
                continue
            momentum.lerp_(parameter.grad, 1 - MOMENTUM)
            steps.append(parameter.grad.lerp(momentum, MOMENTUM))
            moved.append((parameter, rate))
        for (parameter, rate), update in zip(moved, orthogonal(steps), strict=True):
            parameter.add_(update, alpha=-rate * ADAM_RMS * max(parameter.shape) ** 0.5)


def orthogonal(matrices: Sequence[Float[Tensor, "_ _"]]) -> list[Tensor]:
    """Each matrix with singular values near 1 (within 0.7 ... 1.2 of those above 1 % of the largest); 0 stays 0.

    All together as one batch, padded with zeros to one square, which the iteration leaves zero.
    """
    if not matrices:
        return []
    side = max(max(matrix.shape) for matrix in matrices)
    batch = matrices[0].new_zeros((len(matrices), side, side))
    for place, matrix in zip(batch, matrices, strict=True):
        place[: matrix.shape[0], : matrix.shape[1]] = matrix
    # In double precision, in which no square of a single overflows.
    norms = torch.linalg.vector_norm(batch, dim=(1, 2), keepdim=True, dtype=torch.float64)
    batch = (batch / norms.clamp_min(NOTHING)).to(batch.dtype)
    a, b, c = QUINTIC
    for _ in range(ITERATIONS):
        square = batch @ batch.mT
        batch = torch.baddbmm(batch, torch.baddbmm(square, square, square, beta=b, alpha=c), batch, beta=a)
    return [place[: matrix.shape[0], : matrix.shape[1]] for place, matrix in zip(batch, matrices, strict=True)]
