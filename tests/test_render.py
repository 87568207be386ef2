"""The one path from a scene to a picture."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import avg_pool2d

from graings.camera import sampling
from graings.raster.rasterize import rasterize
from graings.raster.result import RasterSettings
from graings.render import draw, low_pass, render
from graings.scene.scene import Scene
from tests.capture.captures import orbit
from tests.models import tiny_scene

WHITE = (1.0, 1.0, 1.0)


def trained_on(scene: Scene, size: tuple[int, int]) -> Scene:
    """`scene` as if its training views had this size."""
    scene.sampling = sampling([orbit(i, 3, size) for i in range(3)])
    return scene


@pytest.mark.parametrize("settings", [None, RasterSettings(blur=7.0, transmittance_min=0.0)])
@pytest.mark.parametrize("share", [0.5, 1.0, 3.0])
def test_a_picture_has_the_low_pass_of_its_scene_in_its_own_pixels(
    settings: RasterSettings | None, share: float
) -> None:
    scene = trained_on(tiny_scene(anchors=40), (32, 32))
    camera = orbit(0, 3, (32, 32)).resized(int(32 * share), int(32 * share))
    composition = scene.compose(camera.center, 0.5)
    assert low_pass(composition, camera) == pytest.approx(scene.config.blur * share**2, rel=1e-12)
    with torch.no_grad():
        asked = replace(settings or RasterSettings(), blur=low_pass(composition, camera))
        expected = rasterize(composition.gaussians, camera, torch.tensor(WHITE), settings=asked).color
        assert torch.equal(draw(composition, camera, WHITE, settings=settings).color, expected)
        assert torch.equal(render(scene, camera, 0.5, WHITE, settings=settings).color, expected)
        other = draw(replace(composition, blur=2.0), camera, WHITE, settings=settings).color
        assert not torch.equal(other, expected)


def test_a_camera_of_training_has_the_low_pass_to_the_bit() -> None:
    scene = trained_on(tiny_scene(anchors=4), (32, 32))
    camera = orbit(1, 3, (32, 32))
    assert low_pass(scene.compose(camera.center, 0.5), camera) == scene.config.blur


@pytest.mark.parametrize("parts", [2, 4])
def test_a_small_picture_is_the_large_one_seen_from_farther(parts: int) -> None:
    """Pixels of the small one are means of the large one's: nearer so than with as many px^2 as there."""
    scene = trained_on(tiny_scene(anchors=40), (64, 64))
    with torch.no_grad():
        scene.scaffold.log_scales -= 1.5  # about a pixel wide
    large = orbit(0, 3, (64, 64))
    small = large.resized(64 // parts, 64 // parts)
    mean = avg_pool2d(render(scene, large, 0.5, WHITE).color.permute(2, 0, 1), parts).permute(1, 2, 0)
    found = render(scene, small, 0.5, WHITE).color
    composition = scene.compose(small.center, 0.5)
    with torch.no_grad():
        dilated = draw(replace(composition, sampling=small.fx * small.fy), small, WHITE).color
    assert 2 * float((found - mean).square().mean()) < float((dilated - mean).square().mean())
