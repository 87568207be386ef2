"""`gather` and `compose`: equal to their oracles, same bits for any number of threads, clear errors for misuse."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from graings import kernel
from graings.scene.children import (
    LOG_SCALE_RANGE,
    MAX_LOG_SCALE_OFFSET,
    ChildGeometry,
    Children,
    compose,
    gather,
    plain_compose,
    plain_gather,
    quaternion_product,
)
from graings.scene.scaffold import Scaffold

SLOTS = 3
TIMES = 3

NetworkOutputs = tuple[Tensor, Children, Tensor | None]


def scaffold(anchors: int, dtype: torch.dtype = torch.float64) -> Scaffold:
    random = torch.Generator().manual_seed(anchors)
    shapes = ((anchors, 3), (anchors, 3), (anchors, 5), (anchors, SLOTS, 3))
    return Scaffold(*(torch.randn(shape, generator=random, dtype=torch.float64).to(dtype) for shape in shapes))


def random_slots(anchors: int, share: float = 0.4) -> Tensor:
    return (torch.rand(anchors * SLOTS, generator=torch.Generator().manual_seed(7)) < share).nonzero().squeeze(-1)


def network_outputs(count: int, dtype: torch.dtype, *, moves: bool) -> NetworkOutputs:
    """Outputs with some log-scales beyond both bounds and one zero quaternion."""
    random = torch.Generator().manual_seed(count)

    def numbers(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64).to(dtype)

    canonical, deformation = numbers(count, 7), numbers(count, TIMES, 10) * 2
    canonical[0, :4] = torch.tensor([-1.0, 0.0, 0.0, 0.0])
    canonical[1, 4:], canonical[2, 4:] = 9.0, -30.0
    return (
        canonical,
        Children(torch.arange(count), numbers(count, 1), numbers(count, 3), numbers(count, 3)),
        deformation if moves else None,
    )


def gathered(function: Callable[..., Children], given: Scaffold, children: Tensor) -> list[Tensor]:
    """Values and gradients for a fixed random upstream gradient."""
    for parameter in given.parameters():
        parameter.grad = None
    result = function(given, children)
    values = [result.inputs, result.canonical_means, result.anchor_log_scales]
    random = torch.Generator().manual_seed(3)
    upstream = [torch.randn(v.shape, generator=random, dtype=torch.float64).to(v.dtype) for v in values]
    torch.autograd.backward(values, upstream)
    assert torch.equal(result.anchors, children // SLOTS)
    return [*(v.detach() for v in values), given.log_scales.grad, given.offsets.grad]  # type: ignore[list-item]


def composed(
    function: Callable[..., list[ChildGeometry]], given: NetworkOutputs, *, projected: bool = True
) -> list[Tensor]:
    canonical, children, deformation = given
    inputs = (canonical, children.anchor_log_scales, children.canonical_means)
    leaves = [t.clone().requires_grad_() for t in inputs]
    if deformation is not None:
        leaves.append(deformation.clone().requires_grad_())
    copies = Children(children.anchors, children.inputs, leaves[2], leaves[1])
    offsets = leaves[3] if deformation is not None else None
    geometry = function(leaves[0], copies, offsets, 1.7, projected_clip=projected)
    values = [value for one in geometry for value in one if value is not None]
    random = torch.Generator().manual_seed(4)
    upstream = [torch.randn(v.shape, generator=random, dtype=torch.float64).to(v.dtype) for v in values]
    return [*(v.detach() for v in values), *torch.autograd.grad(values, leaves, upstream)]


def assert_close(ours: list[Tensor], plain: list[Tensor], relative: float) -> None:
    for value, expected in zip(ours, plain, strict=True):
        assert (value - expected).norm() <= relative * expected.norm()


@pytest.mark.parametrize(("dtype", "relative"), [(torch.float64, 1e-14), (torch.float32, 1e-6)])
@pytest.mark.parametrize("anchors", [1, 40, 1500])
def test_gather_equals_plain_torch(anchors: int, dtype: torch.dtype, relative: float) -> None:
    children = random_slots(anchors, 0.7)
    assert_close(
        gathered(gather, scaffold(anchors, dtype), children),
        gathered(plain_gather, scaffold(anchors, dtype), children),
        relative,
    )


@pytest.mark.parametrize(("dtype", "relative"), [(torch.float64, 1e-14), (torch.float32, 1e-6)])
@pytest.mark.parametrize("projected", [True, False])
@pytest.mark.parametrize("moves", [True, False])
def test_compose_equals_plain_torch(moves: bool, projected: bool, dtype: torch.dtype, relative: float) -> None:
    given = network_outputs(3000, dtype, moves=moves)
    ours, plain = (composed(f, given, projected=projected) for f in (compose, plain_compose))
    # The zero quaternion has derivatives of 1e12, which would hide all others in the norm: they need only be finite.
    first_gradient = 4 * TIMES if moves else 3
    for values in (ours, plain):
        assert values[first_gradient][0, :4].isfinite().all()
        values[first_gradient][0, :4] = 0
    assert_close(ours, plain, relative)


def test_log_scales_stay_within_their_bounds() -> None:
    for geometry in compose(*network_outputs(50, torch.float32, moves=True), 1.0, projected_clip=True):
        assert geometry.log_scales.min() >= LOG_SCALE_RANGE[0]
        assert geometry.log_scales.max() <= LOG_SCALE_RANGE[1]
    child = Children(torch.zeros(1, dtype=torch.int64), torch.zeros(1, 1), torch.zeros(1, 3), torch.zeros(1, 3))
    deformation = torch.tensor([[[0.0] * 7 + [3.0, 0.5, -9.0]]])
    (geometry,) = compose(torch.zeros(1, 7), child, deformation, 1.0, projected_clip=True)
    assert torch.equal(geometry.log_scales, torch.tensor([[MAX_LOG_SCALE_OFFSET, 0.5, -MAX_LOG_SCALE_OFFSET]]))


def test_a_nan_is_not_hidden_by_a_clip() -> None:
    canonical, children, deformation = network_outputs(5, torch.float32, moves=True)
    canonical[3] = torch.nan
    for geometry in compose(canonical, children, deformation, 1.0, projected_clip=True):
        assert geometry.quats[3].isnan().all()
        assert geometry.log_scales[3].isnan().all()
        assert geometry.means.isfinite().all()


@pytest.mark.parametrize("used", range(4))
def test_outputs_that_a_loss_does_not_use_add_nothing_to_gradients(used: int) -> None:
    """Of the second time only one output is used: the others reach the backward pass as no gradient at all."""
    gradients = []
    for function in (compose, plain_compose):
        canonical, children, deformation = network_outputs(400, torch.float64, moves=True)
        leaves = [canonical[1:].requires_grad_(), deformation[1:].requires_grad_()]  # type: ignore[index]
        rows = Children(*(t[1:] for t in dataclasses.astuple(children)))
        value = function(leaves[0], rows, leaves[1], 1.7, projected_clip=True)[1][used]
        found = torch.autograd.grad(value.sin().sum(), leaves, allow_unused=True)
        gradients.append([torch.zeros_like(t) if g is None else g for g, t in zip(found, leaves, strict=True)])
    assert_close(*gradients, relative=1e-13)
    assert not gradients[0][1][:, [0, 2]].any()


def test_times_composed_together_are_those_composed_alone() -> None:
    canonical, children, deformation = network_outputs(500, torch.float32, moves=True)
    assert deformation is not None
    together = compose(canonical, children, deformation, 1.3, projected_clip=True)
    for time, geometry in enumerate(together):
        (alone,) = compose(canonical, children, deformation[:, time : time + 1], 1.3, projected_clip=True)
        assert all(torch.equal(a, b) for a, b in zip(geometry, alone, strict=True))


def test_gradcheck_passes() -> None:
    given = scaffold(6)
    children = random_slots(6, 0.6)
    random = torch.Generator().manual_seed(1)
    deformation = torch.randn(len(children), TIMES, 10, generator=random, dtype=torch.float64) * 0.3
    canonical = torch.randn(len(children), 7, generator=random, dtype=torch.float64) * 0.3

    def through(*values: Tensor) -> tuple[Tensor, ...]:
        holder = scaffold(6)
        for name, value in zip(("log_scales", "offsets"), values, strict=False):
            delattr(holder, name)
            setattr(holder, name, value)
        gathered_children = gather(holder, children)
        geometry = compose(values[2], gathered_children, values[3], 1.3, projected_clip=False)
        return (*(value for one in geometry for value in one), gathered_children.inputs)

    leaves = [t.detach().clone().requires_grad_() for t in (given.log_scales, given.offsets, canonical, deformation)]
    assert torch.autograd.gradcheck(through, leaves)


def test_any_number_of_threads_gives_the_same_bits() -> None:
    results = []
    for threads in (1, 4):
        kernel.set_threads(threads)
        results.append(
            [
                *gathered(gather, scaffold(9000, torch.float32), random_slots(9000)),
                *composed(compose, network_outputs(9000, torch.float32, moves=True)),
            ]
        )
    kernel.set_threads(None)
    assert all(torch.equal(single, parallel) for single, parallel in zip(*results, strict=True))


def test_children_out_of_order_or_out_of_range_are_refused() -> None:
    for wrong in ([2, 1], [1, 1], [-1], [12]):
        with pytest.raises(ValueError, match="ascending order"):
            gather(scaffold(4), torch.tensor(wrong))


def test_no_children_give_no_values_and_zero_gradients() -> None:
    values = gathered(gather, scaffold(4), torch.zeros(0, dtype=torch.int64))
    assert all(len(v) == 0 for v in values[:3])
    assert all(not v.any() for v in values[3:])


@pytest.mark.parametrize("times", [1, 3])
def test_no_children_are_composed_to_none_at_each_time(times: int) -> None:
    none = Children(torch.zeros(0, dtype=torch.int64), *(torch.zeros(0, width) for width in (4, 3, 3)))
    leaves = (torch.zeros(0, 7, requires_grad=True), torch.zeros(0, times, 10, requires_grad=True))
    geometry = compose(leaves[0], none, leaves[1], 1.0, projected_clip=True)
    assert [len(value) for one in geometry for value in one] == [0] * (4 * times)
    total = sum(value.sum() for one in geometry for value in one)
    assert [len(gradient) for gradient in torch.autograd.grad(total, leaves)] == [0, 0]


def test_canonical_means_are_anchor_plus_scale_times_offset() -> None:
    given, children = scaffold(20), torch.tensor([0, 4, 59])
    for row, child in zip(gather(given, children).canonical_means, children.tolist(), strict=True):
        anchor, slot = divmod(child, SLOTS)
        expected = given.anchors[anchor] + given.log_scales[anchor].exp() * given.offsets[anchor, slot]
        torch.testing.assert_close(row, expected, rtol=1e-15, atol=1e-15)


def test_quaternion_product_composes_rotations() -> None:
    half = math.sqrt(0.5)
    about_x, about_y = torch.tensor([[half, half, 0, 0]]), torch.tensor([[half, 0, half, 0]])
    assert torch.allclose(quaternion_product(about_x, about_y), torch.tensor([[0.5, 0.5, 0.5, 0.5]]), atol=1e-7)
