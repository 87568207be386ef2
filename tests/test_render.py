"""The one path from a scene to a picture."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from graings.raster.rasterize import rasterize
from graings.raster.result import RasterSettings
from graings.render import draw, render
from tests.capture.captures import orbit
from tests.models import tiny_scene

WHITE = (1.0, 1.0, 1.0)


@pytest.mark.parametrize("settings", [None, RasterSettings(blur=7.0, transmittance_min=0.0)])
def test_a_picture_has_the_low_pass_of_its_scene(settings: RasterSettings | None) -> None:
    scene = tiny_scene(anchors=40)
    camera = orbit(0, 1, (32, 32))
    composition = scene.compose(camera.center, 0.5)
    assert composition.blur == scene.config.blur
    wide = replace(composition, blur=2.0)
    with torch.no_grad():
        for one in (composition, wide):
            asked = replace(settings or RasterSettings(), blur=one.blur)
            expected = rasterize(one.gaussians, camera, torch.tensor(WHITE), settings=asked).color
            assert torch.equal(draw(one, camera, WHITE, settings=settings).color, expected)
        assert not torch.equal(draw(wide, camera, WHITE).color, draw(composition, camera, WHITE).color)
    drawn = render(scene, camera, 0.5, WHITE, settings=settings).color
    assert torch.equal(drawn, draw(composition, camera, WHITE, settings=settings).color)
