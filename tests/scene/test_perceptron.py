"""The compiled perceptron: equal to torch, within a derived bound in float32, same bits for any number of threads."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from graings import kernel
from graings.scene.perceptron import GroupBias, perceptron, plain_perceptron

UNIT_ROUNDOFF = 2.0**-24  # float32

CHAINS = [(51, 64, 64, 64, 64, 10), (35, 32, 30), (45, 64, 7), (3, 5), (1, 1, 1), (17, 100, 33, 2)]
ROWS = [1, 7, 63, 64, 65, 1111]


@dataclass(frozen=True)
class Chain:
    inputs: Tensor
    weights: list[Tensor]
    biases: list[Tensor]

    def leaves(self) -> list[Tensor]:
        return [self.inputs, *self.weights, *self.biases]

    def to(self, dtype: torch.dtype) -> Chain:
        return Chain(self.inputs.to(dtype), [w.to(dtype) for w in self.weights], [b.to(dtype) for b in self.biases])


def chain(widths: tuple[int, ...], rows: int, seed: int = 0) -> Chain:
    """Weights of the usual initial variance; all numbers are exact in float32."""
    random = torch.Generator().manual_seed(seed + rows + 1000 * len(widths))
    pairs = list(itertools.pairwise(widths))
    weights = [torch.randn(out, width, generator=random) / width**0.5 for width, out in pairs]
    biases = [torch.randn(out, generator=random) * 0.3 for _, out in pairs]
    return Chain(torch.randn(rows, widths[0], generator=random), weights, biases).to(torch.float64)


def upstream(rows: int, width: int) -> Tensor:
    return torch.randn(rows, width, generator=torch.Generator().manual_seed(5)).double()


def differentiate(function: Callable[..., Tensor], given: Chain, v_output: Tensor) -> tuple[Tensor, list[Tensor]]:
    leaves = [leaf.clone().requires_grad_() for leaf in given.leaves()]
    depth = len(given.weights)
    values = function(leaves[0], leaves[1 : depth + 1], leaves[depth + 1 :])
    return values.detach(), list(torch.autograd.grad(values, leaves, v_output.to(values.dtype)))


def with_threads(counts: tuple[int, ...]) -> Iterator[int]:
    """The counts, each while the kernel uses as many threads."""
    try:
        for count in counts:
            kernel.set_threads(count)
            yield count
    finally:
        kernel.set_threads(None)


@pytest.mark.parametrize("widths", CHAINS)
@pytest.mark.parametrize("rows", ROWS)
def test_double_precision_equals_torch(widths: tuple[int, ...], rows: int, isa: str) -> None:
    given, v_output = chain(widths, rows), upstream(rows, widths[-1])
    values, gradients = differentiate(perceptron, given, v_output)
    expected, expected_gradients = differentiate(plain_perceptron, given, v_output)
    torch.testing.assert_close(values, expected, rtol=1e-12, atol=1e-12)
    for gradient, wanted in zip(gradients, expected_gradients, strict=True):
        assert (gradient - wanted).norm() <= 1e-12 * wanted.norm()


def gamma(terms: int) -> float:
    """Bound on the relative error of a sum of `terms` products in float32, in any order."""
    return terms * UNIT_ROUNDOFF / (1 - terms * UNIT_ROUNDOFF)


def bounds(given: Chain, v_output: Tensor) -> tuple[Tensor, list[Tensor], Tensor]:
    """Bounds on the rounding errors of values and gradients (standard forward analysis on magnitudes), and a mask.

    The mask marks rows in which no hidden unit is so near zero that rounding could switch its ReLU.
    """
    levels, errors = [given.inputs], [torch.zeros_like(given.inputs)]
    steady = torch.ones(len(given.inputs), dtype=torch.bool)
    for layer, (weight, bias) in enumerate(zip(given.weights, given.biases, strict=True)):
        raw = levels[-1] @ weight.T + bias
        size = levels[-1].abs() @ weight.abs().T + bias.abs()
        error = errors[-1] @ weight.abs().T * (1 + gamma(weight.shape[1] + 1)) + gamma(weight.shape[1] + 1) * size
        if layer + 1 < len(given.weights):
            steady &= (raw.abs() > error).all(1)
            raw = raw.relu()
        levels.append(raw)
        errors.append(error)
    above, error_above = v_output * steady[:, None], torch.zeros_like(v_output)
    of_weights, of_biases = [], []
    rows = len(given.inputs)
    for layer in range(len(given.weights) - 1, -1, -1):
        weight, level, error = given.weights[layer], levels[layer].abs(), errors[layer]
        grown = (above.abs() + error_above).T
        of_weights.append(gamma(rows) * (grown @ (level + error)) + error_above.T @ level + grown @ error)
        of_biases.append(gamma(rows) * grown.sum(1) + error_above.sum(0))
        error_above = error_above @ weight.abs() + gamma(weight.shape[0]) * (above.abs() + error_above) @ weight.abs()
        above = above @ weight
        if layer > 0:
            active = levels[layer] > 0
            above, error_above = above * active, error_above * active
    return errors[-1], [error_above, *of_weights[::-1], *of_biases[::-1]], steady


@pytest.mark.parametrize("widths", CHAINS)
@pytest.mark.parametrize("rows", [7, 1111])
def test_single_precision_stays_within_its_rounding_bound(widths: tuple[int, ...], rows: int, isa: str) -> None:
    given, v_output = chain(widths, rows), upstream(rows, widths[-1])
    value_bound, gradient_bounds, steady = bounds(given, v_output)
    v_output = v_output * steady[:, None]
    values, gradients = differentiate(perceptron, given.to(torch.float32), v_output)
    expected, expected_gradients = differentiate(plain_perceptron, given, v_output)
    assert steady.sum() > rows / 2
    assert ((values.double() - expected).abs() <= value_bound).all()
    for gradient, wanted, bound in zip(gradients, expected_gradients, gradient_bounds, strict=True):
        assert ((gradient.double() - wanted).abs() <= bound).all()


def test_gradcheck_passes() -> None:
    given = chain((4, 6, 5, 3), 9)
    leaves = [leaf.clone().requires_grad_() for leaf in given.leaves()]
    assert torch.autograd.gradcheck(lambda x, *rest: perceptron(x, rest[:3], rest[3:]), leaves)


@pytest.mark.parametrize("threads", [2, 3, 8])
def test_any_number_of_threads_gives_the_same_bits(threads: int) -> None:
    given, v_output = chain(CHAINS[0], 3000).to(torch.float32), upstream(3000, 10)
    single, parallel = (differentiate(perceptron, given, v_output) for _ in with_threads((1, threads)))
    assert torch.equal(single[0], parallel[0])
    assert all(torch.equal(a, b) for a, b in zip(single[1], parallel[1], strict=True))


def in_groups(rows: int, mean: int, width: int) -> GroupBias:
    """Groups of about `mean` rows; some are empty."""
    random = torch.Generator().manual_seed(rows + mean)
    count = max(1, 2 * rows // mean)
    groups = (torch.rand(rows, generator=random) * count).long().sort().values
    return GroupBias(torch.randn(count, width, generator=random, dtype=torch.float64), groups)


@pytest.mark.parametrize("mean", [2, 7, 5000])  # as children of an anchor; larger than a block of rows
@pytest.mark.parametrize("rows", [1, 513, 3000])
def test_shared_values_are_added_to_the_first_layer(rows: int, mean: int, isa: str) -> None:
    given, v_output = chain((5, 33, 17, 2), rows), upstream(rows, 2)
    values, groups = in_groups(rows, mean, 33)
    results = []
    for function in (plain_perceptron, perceptron):
        leaves = [leaf.clone().requires_grad_() for leaf in (*given.leaves(), values)]
        output = function(leaves[0], leaves[1:4], leaves[4:7], shared=GroupBias(leaves[7], groups))
        results.append([output.detach(), *torch.autograd.grad(output, leaves, v_output)])
    for plain, ours in zip(*results, strict=True):
        assert (ours - plain).norm() <= 1e-12 * plain.norm()


def test_shared_values_have_the_same_bits_for_any_number_of_threads() -> None:
    given, (values, groups) = chain((5, 33, 2), 3000).to(torch.float32), in_groups(3000, 7, 33)
    results = []
    for _ in with_threads((1, 3)):
        leaf = values.float().requires_grad_()
        output = perceptron(given.inputs, given.weights, given.biases, shared=GroupBias(leaf, groups))
        results.append(torch.autograd.grad(output.sin().sum(), leaf)[0])
    assert torch.equal(*results)


def test_groups_out_of_order_or_out_of_range_are_refused() -> None:
    given = chain((4, 6, 3), 3)
    for wrong in ([1, 0, 1], [0, 1, 2], [-1, 0, 0]):
        with pytest.raises(ValueError, match="groups must ascend"):
            perceptron(
                given.inputs,
                given.weights,
                given.biases,
                shared=GroupBias(torch.zeros(2, 6).double(), torch.tensor(wrong)),
            )
    with pytest.raises(ValueError, match=r"shared values must be \[group, 6\]"):
        perceptron(
            given.inputs,
            given.weights,
            given.biases,
            shared=GroupBias(torch.zeros(2, 5).double(), torch.tensor([0, 0, 1])),
        )


def test_rows_do_not_influence_each_other(isa: str) -> None:
    given = chain(CHAINS[0], 200).to(torch.float32)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(1))
    values = perceptron(given.inputs, given.weights, given.biases)
    assert torch.equal(perceptron(given.inputs[order], given.weights, given.biases), values[order])
    poisoned = given.inputs.clone()
    poisoned[77] = torch.nan
    bad = perceptron(poisoned, given.weights, given.biases)
    assert bad[77].isnan().all(), "a NaN must not be hidden by ReLU"
    others = torch.arange(200) != 77
    assert torch.equal(bad[others], values[others])


def test_no_rows_give_no_values_and_zero_gradients() -> None:
    given = chain((4, 6, 3), 0)
    values, gradients = differentiate(perceptron, given, upstream(0, 3))
    assert values.shape == (0, 3)
    assert all(not gradient.any() for gradient in gradients)


def test_no_rows_and_no_groups_give_zero_gradients() -> None:
    given = chain((3, 6, 2), 0)
    leaves = [t.requires_grad_() for t in (torch.zeros(0, 6).double(), *given.weights, *given.biases)]
    groups = GroupBias(leaves[0], torch.zeros(0, dtype=torch.int64))
    output = perceptron(given.inputs, given.weights, given.biases, shared=groups)
    assert output.shape == (0, 2)
    output.sum().backward()
    assert all(leaf.grad is not None and not leaf.grad.any() for leaf in leaves)


def test_misuse_is_refused_with_its_reason() -> None:
    given = chain((4, 6, 3), 5)
    with pytest.raises(ValueError, match="layer 1 has 6 inputs"):
        perceptron(given.inputs, [given.weights[0], given.weights[0]], given.biases)
    with pytest.raises(ValueError, match="needs a weight and a bias"):
        perceptron(given.inputs, given.weights, given.biases[:1])
    with pytest.raises(ValueError, match=r"must all be torch\.float64"):
        perceptron(given.inputs, given.weights, [b.float() for b in given.biases])
