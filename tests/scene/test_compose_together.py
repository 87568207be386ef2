"""Several views composed together: each has the same image as alone, and gradients are the sum over the views."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from graings.camera.camera import Camera
from graings.render import draw
from graings.scene.scene import Composition, Scene
from tests.models import tiny_scene

CAMERAS = [
    Camera.look_at(eye, (0.0, 0.0, 0.0), fov=0.9, width=40, height=30)
    for eye in ((0.0, -2.0, 0.5), (1.5, -2.0, 0.7), (-1.0, 1.8, -0.3))
]
TIMES = [0.1, 0.45, 0.9]
VIEWS = [(camera.center, time) for camera, time in zip(CAMERAS, TIMES, strict=True)]

ABLATIONS: list[dict[str, Any]] = [
    {},
    {"time_conditioning": "concatenated"},
    {"deformation": "anchor"},
    {"deformation": "none"},
    {"stop_gradient": False},
    {"single_mlp": True},
    {"canonical": False},
    {"residual": False},
    {"opacity_view": True},
]


def scene_of(config: dict[str, Any], *, temporal: bool = True) -> Scene:
    """A scene in float64 whose views render different children where opacity depends on time or view."""
    scene = tiny_scene(temporal=temporal, **config).double()
    with torch.no_grad():
        scene.scaffold.opacity_offsets.uniform_(-0.5, 0.1, generator=torch.Generator().manual_seed(0))
    return scene


def image(composition: Composition, camera: Camera) -> Tensor:
    return draw(composition, camera, (1.0, 1.0, 1.0)).color


@pytest.mark.parametrize("temporal", [True, False])
@pytest.mark.parametrize("config", ABLATIONS, ids=str)
def test_each_view_has_the_image_it_has_alone(config: dict[str, Any], temporal: bool) -> None:
    scene = scene_of(config, temporal=temporal)
    for composition, camera, time in zip(scene.compose_together(VIEWS), CAMERAS, TIMES, strict=True):
        alone = scene.compose(camera.center, time)
        assert set(alone.children.tolist()) <= set(composition.children.tolist())
        torch.testing.assert_close(image(composition, camera), image(alone, camera), rtol=0, atol=1e-12)
        torch.testing.assert_close(composition.opacities, alone.opacities, rtol=0, atol=1e-12)


def test_each_view_contains_the_children_of_all_views() -> None:
    scene = scene_of({"residual_scale": 0.5})
    together = scene.compose_together(VIEWS)
    alone = [set(scene.compose(*view).children.tolist()) for view in VIEWS]
    assert len(set(map(frozenset, alone))) > 1
    assert all(set(composition.children.tolist()) == set.union(*alone) for composition in together)


@pytest.mark.parametrize("config", ABLATIONS, ids=str)
def test_gradients_are_the_sum_of_those_alone(config: dict[str, Any]) -> None:
    scene = scene_of(config)
    weights = [torch.rand(30, 40, 3, generator=torch.Generator().manual_seed(i), dtype=torch.float64) for i in range(3)]

    def gradients() -> dict[str, Tensor]:
        by_name = {name: p.grad.clone() for name, p in scene.named_parameters() if p.grad is not None}
        scene.zero_grad()
        return by_name

    for camera, time, weight in zip(CAMERAS, TIMES, weights, strict=True):
        (image(scene.compose(camera.center, time), camera) * weight).sum().backward()
    expected = gradients()
    together = zip(scene.compose_together(VIEWS), CAMERAS, weights, strict=True)
    torch.stack(
        [(image(composition, camera) * weight).sum() for composition, camera, weight in together]
    ).sum().backward()
    computed = gradients()
    assert computed.keys() == expected.keys()
    for name, gradient in expected.items():
        size = float(gradient.abs().max())
        torch.testing.assert_close(computed[name], gradient, rtol=0, atol=1e-10 * max(size, 1e-10), msg=name)
