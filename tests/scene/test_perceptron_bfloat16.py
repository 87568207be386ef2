"""The compiled perceptron with products in bfloat16: exact for small integers, else as of factors rounded by torch."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor

from graings import kernel
from graings.scene.perceptron import GroupBias, bfloat16_products, perceptron, plain_perceptron
from tests.scene.test_perceptron import CHAINS, ROWS, Chain, chain, gamma, in_groups, upstream, with_threads

needs_amx = pytest.mark.skipif(not kernel.has_bfloat16_products(), reason="this CPU has no AMX")


@pytest.fixture
def products() -> Iterator[None]:
    """A test inside the context of products in bfloat16."""
    with bfloat16_products():
        yield


def differentiate(function: Callable[..., Tensor], given: Chain, shared: GroupBias, v_output: Tensor) -> list[Tensor]:
    """Values, and the gradients of inputs, weights, biases and shared values."""
    leaves = [leaf.clone().requires_grad_() for leaf in (*given.leaves(), shared.values)]
    depth = len(given.weights)
    groups = GroupBias(leaves[-1], shared.groups)
    values = function(leaves[0], leaves[1 : depth + 1], leaves[depth + 1 : -1], shared=groups)
    return [values.detach(), *torch.autograd.grad(values, leaves, v_output.to(values.dtype))]


def small_integers(widths: tuple[int, ...], rows: int) -> tuple[Chain, GroupBias, Tensor]:
    """Two weights of +-1 for each unit and for each of its inputs at most: no unit and no gradient exceeds 256.

    Integers up to 256 are exact in bfloat16, and so are their products and sums in float32.
    """
    random = torch.Generator().manual_seed(rows + sum(widths))

    def integers(*shape: int) -> Tensor:
        return torch.randint(-1, 2, shape, generator=random).double()

    weights = []
    for width, out in itertools.pairwise(widths):
        weight = torch.zeros(out, width, dtype=torch.float64)
        for _ in range(2):
            count = min(width, out)
            places = torch.randperm(out, generator=random)[:count], torch.randperm(width, generator=random)[:count]
            weight[places] = integers(count)
        weights.append(weight)
    given = Chain(integers(rows, widths[0]), weights, [integers(out) for out in widths[1:]])
    return given, in_groups_of_integers(rows, widths[1]), integers(rows, widths[-1])


def in_groups_of_integers(rows: int, width: int) -> GroupBias:
    values, groups = in_groups(rows, 7, width)
    return GroupBias(values.round().clamp(-2, 2), groups)


@pytest.mark.parametrize("widths", CHAINS)
@pytest.mark.parametrize("rows", [*ROWS, 5000])
@needs_amx
@pytest.mark.usefixtures("products")
def test_small_integers_give_the_bits_of_torch(widths: tuple[int, ...], rows: int) -> None:
    given, shared, v_output = small_integers(widths, rows)
    expected = differentiate(plain_perceptron, given, shared, v_output)
    single = GroupBias(shared.values.float(), shared.groups)
    assert all(level.abs().max() <= 256 for level in expected[:2])
    ours = differentiate(perceptron, given.to(torch.float32), single, v_output)
    for one, wanted in zip(ours, expected, strict=True):
        assert torch.equal(one.double(), wanted)


def rounded(x: Tensor) -> Tensor:
    return x.bfloat16().double()


@pytest.mark.parametrize("rows", [7, 1111])
@needs_amx
@pytest.mark.usefixtures("products")
def test_factors_are_rounded_to_nearest_and_sums_are_not(rows: int) -> None:
    given, v_output = chain((51, 40), rows), upstream(rows, 40)
    inputs, (weight,), (bias,) = given.inputs, given.weights, given.biases
    exact = rounded(inputs) @ rounded(weight).T + bias
    size = rounded(inputs).abs() @ rounded(weight).abs().T + bias.abs()
    leaves = [leaf.float().requires_grad_() for leaf in given.leaves()]
    values = perceptron(leaves[0], leaves[1:2], leaves[2:])
    assert ((values.double() - exact).abs() <= gamma(53) * size).all()
    v = v_output.float()
    of_inputs, of_weight, of_bias = torch.autograd.grad(values, leaves, v)
    above = rounded(v)
    assert ((of_inputs - above @ rounded(weight)).abs() <= gamma(41) * (above.abs() @ rounded(weight).abs())).all()
    wanted, magnitude = above.T @ rounded(inputs), above.abs().T @ rounded(inputs).abs()
    assert ((of_weight - wanted).abs() <= gamma(rows + 1) * magnitude).all()
    assert ((of_bias - v.double().sum(0)).abs() <= gamma(rows + 1) * v.double().abs().sum(0)).all()


@pytest.mark.parametrize("threads", [2, 5])
@needs_amx
@pytest.mark.usefixtures("products")
def test_any_number_of_threads_gives_the_same_bits(threads: int) -> None:
    given, v_output, shared = chain(CHAINS[0], 5000).to(torch.float32), upstream(5000, 10), in_groups(5000, 7, 64)
    shared = GroupBias(shared.values.float(), shared.groups)
    one, many = (differentiate(perceptron, given, shared, v_output) for _ in with_threads((1, threads)))
    assert all(torch.equal(a, b) for a, b in zip(one, many, strict=True))


@pytest.mark.parametrize("poison", [torch.nan, torch.inf])
@needs_amx
@pytest.mark.usefixtures("products")
def test_a_row_that_is_not_finite_stays_so_and_touches_no_other(poison: float) -> None:
    given = chain(CHAINS[0], 200).to(torch.float32)
    values = perceptron(given.inputs, given.weights, given.biases)
    bad = given.inputs.clone()
    bad[77] = poison
    result = perceptron(bad, given.weights, given.biases)
    assert not result[77].isfinite().all()
    others = torch.arange(200) != 77
    assert torch.equal(result[others], values[others])


@needs_amx
@pytest.mark.usefixtures("products")
def test_no_rows_give_no_values_and_zero_gradients() -> None:
    given = chain((4, 6, 3), 0).to(torch.float32)
    shared = GroupBias(torch.zeros(0, 6), torch.zeros(0, dtype=torch.int64))
    values, *gradients = differentiate(perceptron, given, shared, upstream(0, 3))
    assert values.shape == (0, 3)
    assert all(not gradient.any() for gradient in gradients)


@needs_amx
@pytest.mark.usefixtures("products")
def test_double_precision_and_calls_outside_of_the_context_are_not_rounded() -> None:
    given = chain((51, 40), 64)
    double = perceptron(given.inputs, given.weights, given.biases)
    torch.testing.assert_close(double, plain_perceptron(given.inputs, given.weights, given.biases), rtol=1e-12, atol=0)
    single = given.to(torch.float32)
    within = perceptron(single.inputs, single.weights, single.biases)
    with bfloat16_products(False):
        outside = perceptron(single.inputs, single.weights, single.biases)
    assert (within - double).norm() > 100 * (outside - double).norm()


@needs_amx
@pytest.mark.usefixtures("products")
def test_a_gradient_has_the_precision_of_its_values() -> None:
    """The gradient may be asked for after the context has ended, as optimisers do."""
    given = chain((51, 40, 7), 300).to(torch.float32)
    shared = GroupBias(torch.zeros(1, 40), torch.zeros(300, dtype=torch.int64))
    within = differentiate(perceptron, given, shared, upstream(300, 7))
    leaves = [leaf.clone().requires_grad_() for leaf in given.leaves()]
    values = perceptron(leaves[0], leaves[1:3], leaves[3:])
    with bfloat16_products(False):
        gradients = torch.autograd.grad(values, leaves, upstream(300, 7).float())
    assert all(torch.equal(a, b) for a, b in zip(gradients, within[1:-1], strict=True))


@needs_amx
@pytest.mark.usefixtures("products")
def test_another_thread_is_not_rounded_by_the_context_of_this_one() -> None:
    """One thread may train while another renders, and contexts of two threads may end in any order."""
    given = chain((51, 40), 64).to(torch.float32)
    rounded_values = perceptron(given.inputs, given.weights, given.biases)
    with ThreadPoolExecutor(1) as other:
        values = other.submit(perceptron, given.inputs, given.weights, given.biases).result()
    with bfloat16_products(False):
        assert torch.equal(values, perceptron(given.inputs, given.weights, given.biases))
    assert not torch.equal(values, rounded_values)


def test_another_instruction_set_leaves_them_out(isa: str) -> None:
    given = chain((4, 6, 3), 5).to(torch.float32)
    if kernel.has_bfloat16_products():
        assert isa == "avx512"
        return
    with bfloat16_products(), pytest.raises(ValueError, match="no AMX for products in bfloat16"):
        perceptron(given.inputs, given.weights, given.biases)
