"""From a scene to an image: the low-pass filter and supersampling."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import avg_pool2d

from graings.camera.camera import Camera
from graings.camera.sampling_rate import SamplingRate
from graings.raster.rasterize import rasterize
from graings.raster.result import RasterSettings
from graings.render import MAX_SUPERSAMPLED_PIXELS, draw, low_pass, render, render_composition, supersampling
from graings.scene.scene import Scene
from tests.capture.captures import orbit
from tests.models import tiny_scene

WHITE = (1.0, 1.0, 1.0)


def trained_on(scene: Scene, size: tuple[int, int]) -> Scene:
    """`scene`, with the sampling rate of training views of this size."""
    scene.sampling = SamplingRate.of([orbit(i, 3, size) for i in range(3)], float(scene.extent))
    return scene


@pytest.mark.parametrize("settings", [None, RasterSettings(blur=7.0, transmittance_min=0.0)])
@pytest.mark.parametrize("share", [0.5, 1.0, 3.0])
def test_an_image_uses_the_low_pass_of_its_composition(settings: RasterSettings | None, share: float) -> None:
    scene = trained_on(tiny_scene(anchors=40), (32, 32))
    camera = orbit(0, 3, (32, 32)).resized(int(32 * share), int(32 * share))
    composition = scene.compose(camera.center, 0.5)
    beyond = {0.5: 0.5 * 1.05, 1.0: 1.0, 3.0: 3.0 / 1.05}[share]
    assert low_pass(composition, camera) == pytest.approx(scene.config.blur * beyond**2, rel=1e-12)
    with torch.no_grad():
        asked = replace(settings or RasterSettings(), blur=low_pass(composition, camera))
        expected = rasterize(composition.gaussians, camera, torch.tensor(WHITE), settings=asked).color
        assert torch.equal(draw(composition, camera, WHITE, settings=settings).color, expected)
        if share >= 1:  # smaller images are supersampled
            assert torch.equal(render_composition(composition, camera, WHITE, settings=settings).color, expected)
            assert torch.equal(render(scene, camera, 0.5, WHITE, settings=settings).color, expected)
        other = draw(replace(composition, blur=2.0), camera, WHITE, settings=settings).color
        assert not torch.equal(other, expected)


def test_a_training_camera_has_the_configured_low_pass_to_the_bit() -> None:
    scene = trained_on(tiny_scene(anchors=4), (32, 32))
    camera = orbit(1, 3, (32, 32))
    assert low_pass(scene.compose(camera.center, 0.5), camera) == scene.config.blur


def test_the_low_pass_has_a_constant_width_in_the_scene() -> None:
    """It depends on the camera's sampling rate alone; inside the scene the distance counts as the scene's extent."""
    scene = tiny_scene(anchors=4)
    near, far = (orbit(i, 3, (32, 32), distance) for i, distance in enumerate((2.0, 5.0)))
    scene.sampling = SamplingRate.of([near, far, near], float(scene.extent))
    composition = scene.compose(near.center, 0.5)

    def drawn(camera: Camera) -> tuple[float, int]:
        return low_pass(composition, camera) / scene.config.blur, supersampling(composition, camera)

    assert drawn(near) == (1.0, 1)
    assert drawn(far) == (pytest.approx((1.05 * 2 / 5) ** 2), 2)
    assert drawn(orbit(0, 3, (32, 32), 3.1)) == (pytest.approx((1.05 * 2 / 3.1) ** 2), 1)  # within 1.5 x 1.05
    assert drawn(orbit(0, 3, (32, 32), 3.2)) == (pytest.approx((1.05 * 2 / 3.2) ** 2), 2)
    assert drawn(orbit(0, 3, (32, 32), 10.0)) == (pytest.approx((1.05 / 5) ** 2), 4)
    assert drawn(orbit(0, 3, (16, 16), 15.0)) == (pytest.approx((1.05 / 15) ** 2), 10)
    assert drawn(orbit(0, 3, (32, 32), 1.0)) == (pytest.approx((2 / 1.05) ** 2), 1)
    assert drawn(orbit(0, 3, (32, 32), 1e-3)) == (pytest.approx((2 / 1.05) ** 2), 1)  # as at the extent, which is 1
    assert drawn(orbit(0, 3, (64, 64), 2.0)) == (pytest.approx((2 / 1.05) ** 2), 1)


def test_views_as_coarse_as_training_views_are_not_supersampled() -> None:
    """Views coarser than every training view are."""
    scene = tiny_scene(anchors=4)
    near, far = (orbit(i, 3, (32, 32), distance) for i, distance in enumerate((2.0, 2.5)))
    scene.sampling = SamplingRate.of([near, far, near], float(scene.extent))
    composition = scene.compose(near.center, 0.5)
    distances = (2.0, 2.5, 2.6, 2.7)
    assert [supersampling(composition, orbit(0, 3, (32, 32), d)) for d in distances] == [1, 1, 1, 2]


def test_a_single_close_up_does_not_change_the_sampling_rate() -> None:
    far = [orbit(i, 3, (32, 32), 4.0) for i in range(19)]
    assert SamplingRate.of([*far, orbit(0, 3, (32, 32), 1.0)], 1.0) == SamplingRate.of(far, 1.0)


@pytest.mark.parametrize("share", [1 / 1.04, 1.0, 1.04])
def test_about_the_same_sampling_rate_counts_as_equal(share: float) -> None:
    scene = trained_on(tiny_scene(anchors=4), (32, 32))
    camera = orbit(1, 3, (32, 32))
    other = replace(camera, fx=share * camera.fx, fy=share * camera.fy)
    composition = scene.compose(camera.center, 0.5)
    assert (low_pass(composition, other), supersampling(composition, other)) == (scene.config.blur, 1)


@pytest.mark.parametrize("parts", [2, 4])
def test_a_small_image_is_the_box_average_of_the_training_size(parts: int) -> None:
    scene = trained_on(tiny_scene(anchors=40), (64, 64))
    large = orbit(0, 3, (64, 64))
    whole = render(scene, large, 0.5, WHITE)
    found = render(scene, large.resized(64 // parts, 64 // parts), 0.5, WHITE)
    mean = avg_pool2d(whole.color.permute(2, 0, 1), parts).permute(1, 2, 0)
    torch.testing.assert_close(found.color, mean, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.alpha, avg_pool2d(whole.alpha[None], parts)[0], rtol=0, atol=1e-6)
    torch.testing.assert_close(found.means2d, whole.means2d / parts, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(found.radii, whole.radii / parts, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("size", "shape", "distance"),
    [(43, (43, 43), 4), (56, (56, 56), 4), (25, (25, 13), 4), (9, (9, 31), 4), (64, (64, 64), 8), (43, (43, 43), 13)],
)
def test_supersampling_approaches_the_mean_over_each_pixel(size: int, shape: tuple[int, int], distance: float) -> None:
    """Smaller or more distant views, compared with 16 x 16 samples per pixel: at most a quarter of the error."""
    scene = trained_on(tiny_scene(anchors=40), (64, 64))
    with torch.no_grad():
        scene.scaffold.log_scales -= 1.5  # about a pixel wide
    small = orbit(0, 3, (64, 64), distance).resized(size, size).resized(*shape)
    fine = small.resized(16 * shape[0], 16 * shape[1])
    composition = scene.compose(small.center, 0.5)
    with torch.no_grad():
        mean = avg_pool2d(draw(composition, fine, WHITE).color.permute(2, 0, 1), 16).permute(1, 2, 0)
        at_once = draw(composition, small, WHITE).color
    found = render(scene, small, 0.5, WHITE).color
    assert found.shape == (shape[1], shape[0], 3)
    assert 4 * float((found - mean).square().mean()) < float((at_once - mean).square().mean())


def test_supersampling_matches_the_training_rate_within_the_memory_limit() -> None:
    scene = trained_on(tiny_scene(anchors=4), (64, 64))
    camera = orbit(0, 3, (64, 64))
    composition = scene.compose(camera.center, 0.5)

    def parts(share: float, width: int = 64, height: int = 64) -> int:
        focal = camera.fx * share
        return supersampling(composition, replace(camera, fx=focal, fy=focal, width=width, height=height))

    assert [parts(share) for share in (4, 1, 0.96, 0.94, 0.5, 0.49, 0.26, 0.1)] == [1, 1, 1, 2, 2, 2, 4, 10]
    assert parts(0.01, 4096, 4096) == 1
    assert parts(0.01, 1920, 1080) == 2
    assert parts(1e-200) == math.isqrt(MAX_SUPERSAMPLED_PIXELS // 64**2)


@pytest.mark.parametrize("focal", [1e-300, 1e-200, 1e200, 1e300])
def test_extreme_fields_of_view_give_finite_images(focal: float) -> None:
    scene = trained_on(tiny_scene(anchors=4), (64, 64))
    camera = replace(orbit(0, 3, (16, 16)), fx=focal, fy=focal)
    assert bool(render(scene, camera, 0.5, WHITE).color.isfinite().all())
