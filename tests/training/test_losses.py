"""The terms on the model itself against their equations, written out; and the way back of what they share."""

from __future__ import annotations

import pytest
import torch

from graings.config import LossConfig
from graings.random import RandomStreams
from graings.scene.deformation import Deformation
from graings.training import losses, regularisers
from tests.models import EYE, tiny_scene

RAW = torch.randn(7, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def test_deformation_is_the_mean_over_times_and_gaussians_of_the_squared_offsets() -> None:
    moved = Deformation(torch.stack([RAW, 2 * RAW, -RAW.flip(0)], dim=1).requires_grad_(), extent=2.5)
    rows = [moved.offsets(index) for index in range(3)]
    sizes = [sum((2.5 if i < 3 else 1.0) ** 2 * float(x) ** 2 for i, x in enumerate(row)) for row in RAW]
    assert losses.deformation(moved).item() == pytest.approx((1 + 4 + 1) * sum(sizes) / (3 * 7), rel=1e-14)
    assert torch.equal(moved.position_offsets(1), 2.5 * 2 * RAW[:, :3])
    assert torch.equal(moved.position_offsets(2), rows[2][:, :3])
    plain = sum(row.square().sum() for row in rows) / (3 * 7)
    gradients = [torch.autograd.grad(loss, moved.outputs)[0] for loss in (losses.deformation(moved), plain)]
    torch.testing.assert_close(*gradients, rtol=1e-13, atol=0)


def test_temporal_weighs_a_wide_pair_less() -> None:
    now, there = RAW[:, :3], RAW[:, 3:6]
    expected = sum(float(x - y) ** 2 for x, y in zip(now.flatten(), there.flatten(), strict=True)) / 7
    assert float(losses.temporal(now, there, gap=0.2, mean_gap=0.1)) == pytest.approx(expected / 2, rel=1e-14)


def test_residual_is_the_mean_over_gaussians_too() -> None:
    assert float(losses.residual(RAW[:, :4])) == pytest.approx(float((RAW[:, :4] ** 2).sum()) / 7, rel=1e-14)


def test_alpha_is_the_mean_of_absolute_differences_but_for_those_below_a_level() -> None:
    seen = torch.tensor([[0.0, 1.0], [1.0, 0.5]], dtype=torch.float64)
    drawn = (seen + torch.tensor([[0.4, -1.0], [0.0, 0.5 / 255]], dtype=torch.float64)).requires_grad_()
    value = losses.alpha(drawn, seen)
    half = 0.5 / 255
    assert float(value.detach()) == pytest.approx((0.4 - half + 1.0 - half + half / 4) / 4, rel=1e-14)
    value.backward()
    assert drawn.grad is not None
    assert drawn.grad.tolist() == [[0.25, -0.25], [0.0, pytest.approx(0.125, rel=1e-12)]]


@pytest.mark.parametrize("rows", [RAW, RAW[:, 2:5], RAW[:1], torch.zeros(3, 4, dtype=torch.float64)])
def test_the_gradient_of_a_mean_square(rows: torch.Tensor) -> None:
    leaf = rows.clone().requires_grad_()
    assert torch.autograd.gradcheck(losses.mean_square, (leaf,))


def test_the_temporal_term_takes_every_child_of_a_small_scene_and_a_share_of_a_large_one() -> None:
    looked_at = []
    for anchors in (60, 2_500):
        scene = tiny_scene(anchors=anchors)
        deform = scene.deform

        def counted(children: torch.Tensor, *rest: object, deform=deform) -> object:  # type: ignore[no-untyped-def]
            looked_at.append(len(children))
            assert bool((children.diff() > 0).all())
            return deform(children, *rest)

        scene.deform = counted  # type: ignore[method-assign, assignment]
        one = scene.compose(EYE, 0.5)
        config = LossConfig(deformation=0.0, residual=0.0, rigidity=0.0, temporal_share=0.5)
        term = regularisers.regularisers(
            scene, [one], [0.5], torch.linspace(0, 1, 5).double().numpy(), config, RandomStreams(0)
        )
        assert float(term.detach()) > 0
        looked_at.append(len(one.children))
    small, all_of_small, some, all_of_large = looked_at
    assert small == all_of_small
    assert all_of_large > 4_000
    assert 0.45 < some / all_of_large < 0.55
