from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import write_synthetic
from graings.config import CaptureConfig
from graings.evaluation.evaluate import evaluate
from graings.evaluation.metrics import Pair, SplitMetrics, measure, measure_split, psnr, ssim_3dgs
from graings.evaluation.perceptual import Flip, Lpips, PerceptualDistances
from tests.models import tiny_scene


def noise(seed: int, height: int, width: int) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3))


def ssim_by_the_book(x: np.ndarray, y: np.ndarray) -> float:
    """Eq. 13 of Wang et al. written as one weighted sum per pixel, with nothing beyond the border."""
    u = np.arange(-5, 6)
    window = np.exp(-(u[:, None] ** 2 + u[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    total = []
    for row, column, channel in np.ndindex(x.shape):
        moments = np.zeros(5)
        for i, j in np.ndindex(11, 11):
            r, c = row + i - 5, column + j - 5
            if 0 <= r < x.shape[0] and 0 <= c < x.shape[1]:
                a, b = x[r, c, channel], y[r, c, channel]
                moments += window[i, j] * np.array([a, b, a * a, b * b, a * b])
        ma, mb, aa, bb, ab = moments
        total.append(
            ((2 * ma * mb + 1e-4) * (2 * (ab - ma * mb) + 9e-4))
            / ((ma**2 + mb**2 + 1e-4) * (aa - ma**2 + bb - mb**2 + 9e-4))
        )
    return float(np.mean(total))


def test_psnr_of_a_known_error_is_its_closed_form() -> None:
    target = np.full((4, 5, 3), 100.0 / 255.0)
    assert math.isclose(psnr(target + 10.0 / 255.0, target), 20.0 * math.log10(25.5), rel_tol=1e-12)


def test_psnr_sees_what_eight_bits_hold() -> None:
    target = np.full((2, 2, 3), 100.0 / 255.0)
    assert psnr(target + 0.4 / 255.0, target) == 100.0
    assert psnr(target + 0.6 / 255.0, target) == psnr(target + 1.0 / 255.0, target)
    assert psnr(np.full((2, 2, 3), 7.0), np.ones((2, 2, 3))) == 100.0


def test_black_against_white_is_zero_decibels_and_not_similar() -> None:
    black, white = np.zeros((16, 16, 3)), np.ones((16, 16, 3))
    assert psnr(black, white) == 0.0
    assert 0.0 <= ssim_3dgs(black, white) < 1e-3


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 5), (13, 17)])
def test_ssim_equals_the_definition_written_out_per_pixel(size: tuple[int, int]) -> None:
    # Values that eight bits hold exactly: rounding is the same on both sides.
    x, y = (np.rint(noise(seed, *size) * 255.0) / 255.0 for seed in (1, 2))
    assert math.isclose(ssim_3dgs(x, y), ssim_by_the_book(x, y), rel_tol=0, abs_tol=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (40, 30)])
def test_ssim_of_equal_images_is_one(size: tuple[int, int]) -> None:
    assert abs(ssim_3dgs(noise(0, *size), noise(0, *size)) - 1.0) < 1e-12


def test_ssim_of_flat_images_stays_at_one_in_spite_of_cancelling_variances() -> None:
    flat = np.full((24, 24, 3), 0.6)
    assert abs(ssim_3dgs(flat, flat + 1e-7) - 1.0) < 1e-9


def test_tensors_and_arrays_measure_the_same() -> None:
    x, y = noise(3, 20, 20).astype(np.float32), noise(4, 20, 20).astype(np.float32)
    assert measure(Pair("v", 0.5, torch.from_numpy(x), torch.from_numpy(y))) == measure(Pair("v", 0.5, x, y))


@pytest.mark.parametrize(
    ("image", "target", "message"),
    [
        (np.zeros((4, 4)), np.zeros((4, 4)), r"image must have shape \(H, W, 3\)"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 4)), "target must have shape"),
        (np.zeros((4, 4, 3)), np.zeros((4, 5, 3)), "same size"),
        (np.zeros((0, 4, 3)), np.zeros((0, 4, 3)), "image must have shape"),
        (np.full((4, 4, 3), np.nan), np.zeros((4, 4, 3)), "image must be finite"),
    ],
)
def test_what_is_no_pair_of_images_is_refused(image: np.ndarray, target: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        measure(Pair("v", 0.0, image, target))


def test_a_split_averages_decibels_and_not_errors() -> None:
    target = np.full((4, 4, 3), 100.0 / 255.0)
    pairs = [Pair(f"v{k}", 0.0, target + k / 255.0, target) for k in (1, 10)]
    split = measure_split(pairs)
    expected = 20.0 * math.log10(255.0) - 10.0  # the mean of 20 log 255 and 20 log 25.5
    assert split.psnr is not None
    assert math.isclose(split.psnr, expected, rel_tol=1e-12)
    assert not split.saturated


def test_a_perfect_image_marks_its_split_as_saturated() -> None:
    x = noise(5, 8, 8)
    split = measure_split([Pair("same", 0.0, x, x), Pair("other", 1.0, x, noise(6, 8, 8))])
    assert split.saturated
    assert split.views[0].psnr == 100.0


def test_an_empty_split_has_no_numbers_but_a_reason() -> None:
    document = json.loads(json.dumps(SplitMetrics.over(()).to_json(), allow_nan=False))
    assert (document["psnr"], document["ssim_3dgs"], document["lpips_vgg"]) == (None, None, None)
    assert "no images" in document["reason"]
    assert document["views"] == []


def test_without_a_distance_the_reason_is_that_none_was_requested(tmp_path: Path) -> None:
    capture = load_capture(write_synthetic(tmp_path / "c", frames=4, size=40), CaptureConfig())
    images = ImageStore((1.0, 1.0, 1.0), 64)
    found = evaluate(tiny_scene(anchors=4), capture.train[:1], images, (1.0, 1.0, 1.0))
    assert (found.lpips_vgg, found.lpips_reason) == (None, "LPIPS was not requested")
    assert (found.flip_ldr, found.flip_reason) == (None, "FLIP was not requested")


def test_masked_pixels_change_no_metric() -> None:
    class Distance(torch.nn.Module):
        def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
            return (a - b).abs().mean()

    image, target = noise(7, 40, 48), noise(8, 40, 48)
    valid = noise(9, 40, 48)[..., 0] > 0.4
    spoiled = [np.where(valid[..., None], x, noise(seed, 40, 48)) for seed, x in ((10, image), (11, target))]
    distances = PerceptualDistances(Lpips(Distance(), None), Flip(None, "not installed"))
    whole = measure(Pair("v", 0.0, image, target, valid), distances)
    assert whole.mse == pytest.approx(np.square(rounded(image) - rounded(target))[valid].mean(), rel=1e-12)
    assert whole.compared == pytest.approx(valid.mean())
    other = measure(Pair("v", 0.0, spoiled[0], target, valid), distances)
    assert other == whole
    without = measure(Pair("v", 0.0, spoiled[0], spoiled[1], valid))
    assert (without.psnr, without.ssim_3dgs) == (whole.psnr, whole.ssim_3dgs)


def test_a_mask_that_hides_nothing_changes_no_metric() -> None:
    image, target = noise(7, 20, 24), noise(8, 20, 24)
    whole = measure(Pair("v", 0.0, image, target))
    all_valid = measure(Pair("v", 0.0, image, target, np.ones((20, 24), np.bool_)))
    assert all_valid.psnr == whole.psnr
    assert all_valid.ssim_3dgs == pytest.approx(whole.ssim_3dgs, abs=1e-13)


def test_a_window_with_one_valid_pixel_compares_only_its_colour() -> None:
    image, target = noise(7, 21, 21), noise(8, 21, 21)
    valid = np.zeros((21, 21), np.bool_)
    valid[10, 10] = True  # farther from the border than a window reaches
    x, y = rounded(image)[10, 10], rounded(target)[10, 10]
    luminance = (2 * x * y + 0.01**2) / (x**2 + y**2 + 0.01**2)
    assert ssim_3dgs(image, target, valid) == pytest.approx(float(luminance.mean()), abs=1e-9)


def test_a_view_that_is_masked_everywhere_is_left_out_of_the_means() -> None:
    x, y = noise(1, 8, 8), noise(2, 8, 8)
    nothing = np.zeros((8, 8), np.bool_)
    split = measure_split([Pair("hidden", 0.0, x, y, nothing), Pair("seen", 0.5, x, y)])
    assert [view.name for view in split.views] == ["seen"]
    assert measure_split([Pair("hidden", 0.0, x, y, nothing)]).psnr is None


def rounded(image: np.ndarray) -> np.ndarray:
    return np.rint(image * 255) / 255
