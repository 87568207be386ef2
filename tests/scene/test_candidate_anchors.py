"""Only anchors with a child that may be rendered are evaluated for colour and residual, without changing the result."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from graings import constants
from graings.scene.encoding import direction_width
from graings.scene.scene import Scene
from tests.models import EYE, tiny_scene

TIME = 0.4
ETA = 0.1
ANCHORS = 60


def scene_of(**config: Any) -> Scene:
    """In float64: scores from far below to far above the rendering threshold, and residuals up to their bounds."""
    scene = tiny_scene(anchors=ANCHORS, residual_scale=ETA, **config).double()
    with torch.no_grad():
        highest = torch.linspace(-0.4, 0.5, ANCHORS, dtype=torch.float64).atanh()
        logits = scene.appearance.opacity_logits(scene.scaffold.features, scene.directions(EYE))
        scene.scaffold.opacity_offsets.copy_(highest - logits.amax(-1))
        if scene.residual is not None:
            for head in (scene.residual, scene.residual.seeing):
                if head is not None:
                    head.out.weight.mul_(1e3)
    return scene


def canonical_opacities(scene: Scene) -> Tensor:
    """o_can [A, k] of every slot."""
    offsets = scene.scaffold.opacity_offsets.unsqueeze(-1)
    logits = scene.appearance.opacity_logits(scene.scaffold.features, scene.directions(EYE))
    return torch.tanh(logits + offsets).detach()


def all_slots(scene: Scene) -> tuple[Tensor, Tensor]:
    """Scores [A, k] and colours [A k, 3] of every slot, rendered or not."""
    scaffold = scene.scaffold
    scores = canonical_opacities(scene)
    colors = scene.appearance.color_logits(
        scene.appearance.color_part(scaffold.features), scene.directions(EYE)
    ).sigmoid()
    if scene.residual is not None:
        time = torch.tensor([TIME], dtype=torch.float64)
        residual = ETA * torch.tanh(scene.residual(scene.residual.part(scaffold.features), time, scene.directions(EYE)))
        scores, colors = scores + residual[..., 3], (colors + residual[..., :3].flatten(0, 1)).clamp(0, 1)
    return scores.detach(), colors.detach()


@pytest.mark.parametrize(
    "config", [{}, {"residual": False}, {"residual_sh_degree": 0}, {"opacity_view": True}], ids=str
)
def test_composition_equals_the_evaluation_of_every_anchor(config: dict[str, Any]) -> None:
    scene = scene_of(**config)
    scores, colors = all_slots(scene)
    composition = scene.compose(EYE, TIME)
    assert torch.equal(composition.children, (scores.flatten() > constants.ALPHA_MIN).nonzero().squeeze(-1))
    gaussians = composition.gaussians
    torch.testing.assert_close(gaussians.opacities, scores.flatten()[composition.children], rtol=0, atol=1e-12)
    torch.testing.assert_close(gaussians.colors, colors[composition.children], rtol=0, atol=1e-12)


def test_the_residual_can_make_an_anchor_visible() -> None:
    scene = scene_of()
    highest = canonical_opacities(scene).amax(-1)
    owners = scene.compose(EYE, TIME).children // scene.scaffold.slots
    assert int((highest[owners] <= constants.ALPHA_MIN).sum()) > 0


def test_only_candidate_anchors_are_evaluated_for_residual_and_colour() -> None:
    scene = scene_of(feature_dim=7, head_width=9, static_width=10)  # widths that differ from those of directions
    config = scene.config
    candidates = int((canonical_opacities(scene).amax(-1) + ETA > constants.ALPHA_MIN).sum())
    assert config.head_width < candidates < ANCHORS
    saved: list[tuple[int, ...]] = []  # shapes that autograd keeps: among them the inputs of every network

    def record(tensor: Tensor) -> Tensor:
        saved.append(tuple(tensor.shape))
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(record, lambda tensor: tensor):
        scene.compose(EYE, TIME)
    color_inputs = 2 * direction_width(config.color_sh_degree)
    residual_inputs = direction_width(config.residual_sh_degree)
    for width in (color_inputs, residual_inputs, config.head_width):
        assert (candidates, width) in saved
        assert (ANCHORS, width) not in saved


def test_only_candidate_anchors_get_a_gradient() -> None:
    scene = scene_of()
    gaussians = scene.compose(EYE, TIME).gaussians
    (gaussians.colors.sum() + gaussians.opacities.sum()).backward()
    gradient = scene.scaffold.features.grad
    assert gradient is not None
    candidates = canonical_opacities(scene).amax(-1) + ETA > constants.ALPHA_MIN
    assert float(gradient[~candidates].abs().max()) == 0.0
    assert float(gradient[candidates].abs().max()) > 0.0


def test_a_scene_without_candidates_has_no_gaussians() -> None:
    scene = scene_of()
    with torch.no_grad():
        scene.scaffold.opacity_offsets.fill_(-3.0)
    composition = scene.compose(EYE, TIME)
    assert len(composition.children) == 0
    assert composition.opacities.shape == (ANCHORS, scene.scaffold.slots)
    assert float(composition.opacities.max()) <= constants.ALPHA_MIN
