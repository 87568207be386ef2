"""Rigidity: bending costs, rotation and translation do not, and only the deformation gets a gradient."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from graings.config import LossConfig
from graings.random import RandomStreams
from graings.scene.scene import Composition, Scene
from graings.training import losses
from graings.training.regularisers import regularisers
from tests.models import EYE, tiny_scene

TIMES = np.array([0.0, 0.3, 0.6, 1.0])
ONLY_RIGIDITY = {"temporal": 0.0, "deformation": 0.0, "residual": 0.0, "rigidity": 1.0}


def strain(scene: Scene, compositions: list[Composition], **config: object) -> Tensor:
    """The term of these compositions alone."""
    loss = LossConfig.model_validate(ONLY_RIGIDITY | config)
    return regularisers(scene, compositions, list(TIMES), TIMES, loss, RandomStreams(0))


def placed(compositions: list[Composition], places: list[Tensor]) -> list[Composition]:
    """The compositions with their children moved to `places`."""
    moved = []
    for one, where in zip(compositions, places, strict=True):
        moved.append(dataclasses.replace(one, position_offsets=where - one.canonical_means.detach()))
    return moved


def together(scene: Scene) -> list[Composition]:
    return scene.compose_together([(EYE, float(time)) for time in TIMES])


def test_rigid_motion_costs_nothing_and_bending_does() -> None:
    scene = tiny_scene(anchors=60)
    compositions = together(scene)
    canonical = compositions[0].canonical_means.detach()
    turns = torch.linalg.qr(torch.randn(len(TIMES), 3, 3, generator=torch.Generator().manual_seed(0))).Q
    flights = torch.linspace(-3, 3, len(TIMES))
    rigid = [canonical @ turn.T + large_motion for turn, large_motion in zip(turns, flights, strict=True)]
    assert float(strain(scene, placed(compositions, rigid))) < 1e-5
    x, y, z = canonical.unbind(1)
    bent = [torch.stack([x + time * x.square(), y, z], 1) for time in TIMES.tolist()]
    assert float(strain(scene, placed(compositions, bent))) > 1e-2


def test_children_invisible_at_one_time_have_no_weight() -> None:
    """Composed together, a child may be drawn in one view and be below zero in another; strain is no gain there."""
    scene = tiny_scene(anchors=60)
    compositions = together(scene)
    canonical = compositions[0].canonical_means.detach()
    apart = placed(compositions, [canonical * (1 + time) for time in TIMES.tolist()])
    gaussians = apart[2].gaussians
    faded = dataclasses.replace(gaussians, opacities=gaussians.opacities.detach() * 0 - 0.05)
    apart[2] = dataclasses.replace(apart[2], gaussians=faded)
    assert float(strain(scene, apart)) == 0.0
    faded = dataclasses.replace(gaussians, opacities=torch.where(torch.arange(len(canonical)) % 2 == 0, -0.05, 0.5))
    apart[2] = dataclasses.replace(apart[2], gaussians=faded)
    assert float(strain(scene, apart)) > 0.0


def test_the_strain_of_a_stretched_pair_is_its_share_of_the_mean_length() -> None:
    lengths = torch.tensor([[0.8, 1.0, 7.0], [1.2, 1.0, 9.0]])
    weights = torch.tensor([0.5, 1.0, 0.0])
    slight = losses.SLIGHT_STRAIN
    stretched = math.sqrt(0.2**2 + slight**2) - slight
    # Weights that sum to more than one Gaussian's make a mean.
    assert float(losses.rigidity(lengths, weights)) == pytest.approx(0.5 * stretched / 1.5, rel=1e-6)
    assert float(losses.rigidity(10 * lengths, weights)) == pytest.approx(0.5 * stretched / 1.5, rel=1e-6)


def test_rigidity_gives_no_gradient_to_canonical_positions() -> None:
    scene = tiny_scene(anchors=60)
    strain(scene, together(scene)).backward()
    asked = {name for name, p in scene.named_parameters() if p.grad is not None and bool((p.grad != 0).any())}
    assert asked
    assert {name.split(".")[0] for name in asked} == {"deformation"}


def test_the_gradient_is_that_of_the_formula() -> None:
    lengths = (torch.rand(3, 8, dtype=torch.float64) + 0.5).requires_grad_()
    weights = torch.rand(8, dtype=torch.float64)
    losses.rigidity(lengths, weights).backward()
    assert lengths.grad is not None
    mean = lengths.detach().mean(0)

    def cost(values: Tensor) -> Tensor:  # the length beside which a strain is measured is a constant
        strains = (values - values.mean(0)) / mean
        roots = (strains.square() + losses.SLIGHT_STRAIN**2).sqrt() - losses.SLIGHT_STRAIN
        return (roots.mean(0) * weights).sum() / weights.sum().clamp_min(1.0)

    start, step = lengths.detach(), 1e-6
    for place in np.ndindex(*lengths.shape):
        shift = torch.zeros_like(start)
        shift[place] = step
        numeric = float(cost(start + shift) - cost(start - shift)) / (2 * step)
        assert float(lengths.grad[place]) == pytest.approx(numeric, abs=1e-8)


def test_a_step_of_one_view_a_still_scene_and_coincident_children_have_no_strain() -> None:
    scene = tiny_scene(anchors=60)
    assert float(strain(scene, together(scene)[:1])) == 0
    assert float(strain(scene, together(scene), rigidity=0.0)) == 0
    assert float(strain(tiny_scene(temporal=False), together(tiny_scene(temporal=False)))) == 0
    compositions = together(scene)
    here = torch.zeros_like(compositions[0].canonical_means)
    nowhere = placed(compositions, [here + float(time) for time in TIMES])
    assert float(strain(scene, nowhere)) == 0
