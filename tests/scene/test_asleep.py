"""Anchors whose children cannot be drawn at any instant are asked for nothing but opacity, and nobody can tell."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from graings import constants
from graings.scene.scene import Scene
from tests.models import EYE, tiny_scene

TIME = 0.4
ETA = 0.1


def scene_of(**config: Any) -> Scene:
    """In float64: scores from far below to far above what is drawn, and a residual that goes to its bounds."""
    scene = tiny_scene(anchors=60, residual_scale=ETA, **config).double()
    with torch.no_grad():
        brightest = torch.linspace(-0.4, 0.5, 60, dtype=torch.float64).atanh()
        logits = scene.appearance.opacity_logits(scene.scaffold.features, scene.directions(EYE))
        scene.scaffold.opacity_offsets.copy_(brightest - logits.amax(-1))
        if scene.residual is not None:
            for head in (scene.residual, scene.residual.seeing):
                if head is not None:
                    head.out.weight.mul_(1e3)
    return scene


def lasting(scene: Scene) -> Tensor:
    """Score [A, k] of every slot without its residual."""
    offsets = scene.scaffold.opacity_offsets.unsqueeze(-1)
    logits = scene.appearance.opacity_logits(scene.scaffold.features, scene.directions(EYE))
    return torch.tanh(logits + offsets).detach()


def everything(scene: Scene) -> tuple[Tensor, Tensor]:
    """Scores [A, k] and colours [A k, 3] of every slot, drawn or not."""
    scaffold = scene.scaffold
    slots = torch.arange(scaffold.count * scaffold.slots)
    scores, colors = lasting(scene), scene.appearance.colors(scaffold.features, scene.directions(EYE), slots)
    if scene.residual is not None:
        moment = torch.tensor([TIME], dtype=torch.float64)
        change = ETA * torch.tanh(scene.residual(scaffold.features, moment, scene.directions(EYE)))
        scores, colors = scores + change[..., 3], (colors + change[..., :3].flatten(0, 1)).clamp(0, 1)
    return scores.detach(), colors.detach()


@pytest.mark.parametrize(
    "config", [{}, {"residual": False}, {"residual_sh_degree": 0}, {"opacity_view": True}], ids=str
)
def test_what_is_drawn_is_what_asking_every_anchor_gives(config: dict[str, Any]) -> None:
    scene = scene_of(**config)
    scores, colors = everything(scene)
    composition = scene.compose(EYE, TIME)
    assert torch.equal(composition.children, (scores.flatten() > constants.ALPHA_MIN).nonzero().squeeze(-1))
    drawn = composition.gaussians
    torch.testing.assert_close(drawn.opacities, scores.flatten()[composition.children], rtol=0, atol=1e-12)
    torch.testing.assert_close(drawn.colors, colors[composition.children], rtol=0, atol=1e-12)


def test_the_residual_wakes_anchors_that_are_nothing_without_it() -> None:
    scene = scene_of()
    brightest = lasting(scene).amax(-1)
    owners = scene.compose(EYE, TIME).children // scene.scaffold.slots
    assert int((brightest[owners] <= constants.ALPHA_MIN).sum()) > 0


def test_only_anchors_that_may_be_drawn_are_asked_for_residual_and_colour() -> None:
    scene = scene_of()
    asked: dict[str, int] = {}
    assert scene.residual is not None
    scene.residual.register_forward_hook(lambda _, inputs, __: asked.update(residual=len(inputs[0])))
    colors = scene.appearance.colors

    def counted(features: Tensor, *rest: Tensor) -> Tensor:
        asked.update(colour=len(features))
        return colors(features, *rest)

    scene.appearance.colors = counted  # type: ignore[method-assign]
    possible = int((lasting(scene).amax(-1) + ETA > constants.ALPHA_MIN).sum())
    scene.compose(EYE, TIME)
    assert 0 < possible < 60
    assert asked == {"residual": possible, "colour": possible}


def test_anchors_asleep_get_no_gradient_and_others_do() -> None:
    scene = scene_of()
    gaussians = scene.compose(EYE, TIME).gaussians
    (gaussians.colors.sum() + gaussians.opacities.sum()).backward()
    gradient = scene.scaffold.features.grad
    assert gradient is not None
    asleep = lasting(scene).amax(-1) + ETA <= constants.ALPHA_MIN
    assert float(gradient[asleep].abs().max()) == 0.0
    assert float(gradient[~asleep].abs().max()) > 0.0


def test_a_scene_all_asleep_is_composed_of_nothing() -> None:
    scene = scene_of()
    with torch.no_grad():
        scene.scaffold.opacity_offsets.fill_(-3.0)
    composition = scene.compose(EYE, TIME)
    assert len(composition.children) == 0
    assert composition.opacities.shape == (60, scene.scaffold.slots)
    assert float(composition.opacities.max()) <= constants.ALPHA_MIN
