"""What a camera cannot see gets no colour, and no image changes by that."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from graings import kernel
from graings.camera.camera import Camera
from graings.camera.frustum import Frustum
from graings.raster.result import RasterSettings
from graings.render import MAX_SUPERSAMPLED_PIXELS, draw, render, render_composition
from graings.scene.prepared import PreparedScene
from graings.scene.scene import Scene
from tests.models import tiny_scene

BLACK = (0.0, 0.0, 0.0)
FAR = Camera.look_at((0.0, -2.0, 0.5), (0.0, 0.0, 0.0), fov=0.9, width=40, height=30)
CAMERAS = {
    "all in view": FAR,
    "narrow": replace(FAR, fx=400.0, fy=300.0),
    "off centre": replace(FAR, fx=100.0, cx=-35.0, cy=55.0),
    "inside": Camera.look_at((0.3, 0.1, 0.0), (1.0, 0.0, 0.2), fov=1.9, width=40, height=30),
    "turned away": Camera.look_at((0.0, -2.0, 0.5), (0.0, -4.0, 0.5), fov=0.9, width=40, height=30),
    "wide": Camera.look_at((0.1, -0.4, 0.0), (0.1, 0.0, 0.0), fov=2.9, width=64, height=9),
}
SETTINGS = {
    "default": RasterSettings(),
    "compat": RasterSettings(compat=True),
    "faint": RasterSettings(alpha_min=1e-9),
    "endless": RasterSettings(alpha_min=0.0, transmittance_min=0.0),
    "narrow margin": RasterSettings(frustum_margin=-0.9),
    "distant near plane": RasterSettings(near=1.9),
}
CONFIGS: list[dict[str, Any]] = [
    {},
    {"residual_sh_degree": 0, "reflection": False},
    {"residual": False},
    {"children": 1, "opacity_view": True},
]


def scene_of(config: dict[str, Any]) -> Scene:
    """A scene of Gaussians of all sizes, the largest as large as the scene."""
    scene = tiny_scene(anchors=600, **config)
    with torch.no_grad():
        sizes = torch.rand(600, 1, generator=torch.Generator().manual_seed(3))
        scene.scaffold.log_scales.copy_(-7.0 + 7.0 * sizes**4 + 0.5 * torch.randn(600, 3))
    return scene


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_images_are_those_with_all_colours(config: dict[str, Any], name: str) -> None:
    scene, camera = scene_of(config), CAMERAS[name]
    prepared = PreparedScene(scene)
    for kind, settings in SETTINGS.items():
        with torch.no_grad():
            composition = scene.compose(camera.center, 0.31)
        expected = render_composition(composition, camera, BLACK, settings=settings)
        found = render(prepared, camera, 0.31, BLACK, settings=settings)
        for one, other in ((found.color, expected.color), (found.alpha, expected.alpha)):
            assert torch.equal(one, other), kind
        assert found.culled == expected.culled


@pytest.mark.parametrize("seed", range(20))
def test_whatever_is_drawn_has_its_colour(seed: int) -> None:
    random = np.random.default_rng(seed)
    scene = scene_of({})
    prepared = PreparedScene(scene)
    eye, target = random.normal(size=(2, 3)) * 0.7
    camera = Camera.look_at(
        tuple(eye), tuple(target), fov=random.uniform(0.05, 2.5), width=50, height=random.integers(5, 90)
    )
    blur = random.uniform(0.0, 2.0)
    frustum = Frustum(camera, near=0.01, reach=3.5, blur=blur, margin=0.3)
    whole, some = prepared.compose(camera.center, 0.5), prepared.compose(camera.center, 0.5, frustum)
    drawn = draw(whole, camera, BLACK, settings=RasterSettings(blur=whole.blur)).radii.amax(-1) > 0
    computed = (some.gaussians.colors == whole.gaussians.colors).all(-1)
    assert bool(computed[drawn].all())


def test_of_a_narrow_view_most_colours_are_left_out() -> None:
    prepared = PreparedScene(tiny_scene(anchors=600))
    frustum = Frustum(replace(FAR, fx=4000.0, fy=3000.0), near=0.01, reach=3.5, blur=0.3, margin=0.3)
    colors = prepared.compose(FAR.center, 0.5, frustum).gaussians.colors
    assert 0 < float((colors.amax(-1) > 0).float().mean()) < 0.3
    away = Frustum(CAMERAS["turned away"], near=0.01, reach=3.5, blur=0.3, margin=0.3)
    assert bool((prepared.compose(FAR.center, 0.5, away).gaussians.colors == 0).all())


def test_a_view_that_is_supersampled_is_the_same_too() -> None:
    scene = scene_of({})
    camera = FAR.resized(8, 6)
    with torch.no_grad():
        expected = render_composition(scene.compose(camera.center, 0.2), camera, BLACK)
    assert camera.width * camera.height < MAX_SUPERSAMPLED_PIXELS
    assert torch.equal(render(PreparedScene(scene), camera, 0.2, BLACK).color, expected.color)


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("threads", [1, 3])
def test_any_instruction_set_and_number_of_threads_gives_the_same_bits(threads: int) -> None:
    scene = scene_of({})
    camera = CAMERAS["narrow"]
    with torch.no_grad():
        expected = draw(scene.compose(camera.center, 0.2), camera, BLACK).color
    with kernel.computing_threads(threads):
        assert torch.equal(render(PreparedScene(scene), camera, 0.2, BLACK).color, expected)
