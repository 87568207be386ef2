"""`child_colors`: equal to its oracle, same bits for any number of threads, clear errors for misuse."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from graings import kernel
from graings.scene.child_colors import ChildColors, child_colors, plain_child_colors

SLOTS = 9000
BOUND = 0.4


def outputs(dtype: torch.dtype, *, changes: bool) -> tuple[Tensor, Tensor | None, Tensor]:
    """Outputs of the networks, of which some lead beyond both bounds of the clip, and two fifths of the slots."""
    random = torch.Generator().manual_seed(5)
    canonical, residual = torch.randn(SLOTS, 3, generator=random) * 4, torch.randn(SLOTS, 4, generator=random) * 2
    children = (torch.rand(SLOTS, generator=random) < 0.4).nonzero().squeeze(-1)
    return canonical.to(dtype), residual.to(dtype) if changes else None, children


def evaluated(function: Callable[..., ChildColors], dtype: torch.dtype, changes: bool, projected: bool) -> list[Tensor]:
    """Values, and gradients for a fixed random upstream gradient."""
    canonical, residual, children = outputs(dtype, changes=changes)
    leaves = [t.requires_grad_() for t in (canonical, residual) if t is not None]
    found = function(canonical, residual, children, BOUND, projected_clip=projected)
    values = [value for value in found if value is not None]
    random = torch.Generator().manual_seed(6)
    upstream = [torch.randn(v.shape, generator=random, dtype=torch.float64).to(v.dtype) for v in values]
    return [*(v.detach() for v in values), *torch.autograd.grad(values, leaves, upstream)]


@pytest.mark.parametrize(("dtype", "relative"), [(torch.float64, 1e-14), (torch.float32, 5e-7)])
@pytest.mark.parametrize("projected", [True, False])
@pytest.mark.parametrize("changes", [True, False])
def test_equals_plain_torch(changes: bool, projected: bool, dtype: torch.dtype, relative: float) -> None:
    ours, plain = (evaluated(f, dtype, changes, projected) for f in (child_colors, plain_child_colors))
    assert len(ours) == (4 if changes else 2)
    for found, expected in zip(ours, plain, strict=True):
        assert found.shape == expected.shape
        assert (found - expected).norm() <= relative * expected.norm()
    if changes:
        assert ((ours[0] == 0).any(), (ours[0] == 1).any()) == (True, True)
        assert torch.equal(ours[0], plain[0])
        assert torch.equal(ours[1], plain[1])


@pytest.mark.parametrize("isa", kernel.available_isas())
def test_every_instruction_set_gives_the_values_of_the_oracle(isa: str) -> None:
    before = kernel.active_isa()
    expected = evaluated(plain_child_colors, torch.float64, True, True)
    kernel.use_isa(isa)
    try:
        found = evaluated(child_colors, torch.float64, True, True)
    finally:
        kernel.use_isa(before)
    for ours, plain in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, plain, rtol=1e-13, atol=1e-16)


@pytest.mark.parametrize("used", [0, 1])
def test_an_output_that_a_loss_does_not_use_adds_nothing_to_gradients(used: int) -> None:
    gradients = []
    for function in (child_colors, plain_child_colors):
        canonical, residual, children = outputs(torch.float64, changes=True)
        assert residual is not None
        leaves = (canonical.requires_grad_(), residual.requires_grad_())
        value = function(*leaves, children, BOUND, projected_clip=False)[used]
        assert value is not None
        found = torch.autograd.grad(value.square().sum(), leaves, allow_unused=True)
        gradients.append([torch.zeros_like(t) if g is None else g for g, t in zip(found, leaves, strict=True)])
    for ours, plain in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, plain, rtol=1e-13, atol=0)


def test_only_drawn_slots_receive_gradients() -> None:
    *_, children = outputs(torch.float32, changes=True)
    for gradient in evaluated(child_colors, torch.float32, True, True)[2:]:
        others = torch.ones(SLOTS, dtype=torch.bool)
        others[children] = False
        assert not gradient[others].any()
        assert gradient[children].any(dim=1).float().mean() > 0.9


def test_gradcheck_passes() -> None:
    random = torch.Generator().manual_seed(2)
    canonical, residual = (torch.randn(12, width, generator=random, dtype=torch.float64) for width in (3, 4))
    children = torch.tensor([0, 3, 4, 11])

    def through(*leaves: Tensor) -> tuple[Tensor, ...]:
        found = child_colors(*leaves, children, BOUND, projected_clip=False)
        assert found.residual is not None
        return found.colors, found.residual

    assert torch.autograd.gradcheck(through, (canonical.requires_grad_(), residual.requires_grad_()))


def test_any_number_of_threads_gives_the_same_bits() -> None:
    results = []
    for threads in (1, 4):
        kernel.set_threads(threads)
        results.append(evaluated(child_colors, torch.float32, True, True))
    kernel.set_threads(None)
    assert all(torch.equal(single, parallel) for single, parallel in zip(*results, strict=True))


def test_a_nan_is_not_hidden_by_the_clip() -> None:
    canonical, residual, children = outputs(torch.float32, changes=True)
    canonical[children[0]] = torch.nan
    assert residual is not None
    residual[children[1]] = torch.nan
    found = child_colors(canonical, residual, children, BOUND, projected_clip=True)
    assert found.colors[:2].isnan().all()
    assert found.colors[2:].isfinite().all()


@pytest.mark.parametrize("wrong", [[2, 1], [1, 1], [-1], [12]])
def test_children_out_of_order_or_out_of_range_are_refused(wrong: list[int]) -> None:
    with pytest.raises(ValueError, match="ascending order"):
        child_colors(torch.zeros(12, 3), None, torch.tensor(wrong), BOUND, projected_clip=True)


@pytest.mark.parametrize("slots", [0, 4])
def test_no_children_give_no_colours_and_zero_gradients(slots: int) -> None:
    leaves = (torch.ones(slots, 3, requires_grad=True), torch.ones(slots, 4, requires_grad=True))
    found = child_colors(*leaves, torch.zeros(0, dtype=torch.int64), BOUND, projected_clip=True)
    assert found.residual is not None
    assert (len(found.colors), len(found.residual)) == (0, 0)
    gradients = torch.autograd.grad(found.colors.sum() + found.residual.sum(), leaves)
    assert not any(gradient.any() for gradient in gradients)
