"""What the statistics of a capture find, and what they must not overlook (numerics notes 5.6, PT2 to PT9 and PT15)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graings.capture.capture import Frame
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import write_synthetic
from graings.config import CaptureConfig
from graings.plan.capture_statistics import MAX_IMAGES, _cameras, _sample, measure
from tests.capture.captures import entry, orbit, write_colmap, write_image, write_transforms
from tests.plan.fixed_cameras import WHITE, noisy, shifted, square, statistics_of, texture, write_fixed


def ratio(folder: Path) -> float:
    change = statistics_of(folder).change
    assert change is not None
    return change.ratio


@pytest.mark.parametrize("sigma", [0.0, 0.01, 0.04])
def test_a_resting_scene_does_not_change_and_its_noise_is_measured(tmp_path: Path, sigma: float) -> None:
    found = statistics_of(write_fixed(tmp_path, lambda c, t: noisy(texture(), sigma, c, t), cameras=3))
    assert found.change is not None
    assert found.change.ratio <= 1
    assert found.noise == pytest.approx(sigma, rel=0.15, abs=1e-3)
    assert found.camera_motion == "fixed"
    assert (found.cameras, found.times, found.images, found.simultaneous) == (3, 8, 24, 3)


def test_a_blinking_square_of_3_px_in_one_of_40_images_is_found(tmp_path: Path) -> None:
    """PT2."""
    plain = texture(200)

    def draw(camera: int, index: int) -> np.ndarray:
        return noisy(square(plain, 90, 120, 3, (1, 1, 1)) if index == 17 else plain, 0.005, index)

    found = statistics_of(write_fixed(tmp_path, draw, times=40, size=200)).change
    assert found is not None
    assert found.ratio > 1
    assert found.image == "train/c0_017.png"
    assert found.tile == (5, 7)


def test_a_drift_below_the_noise_of_two_images_is_found_between_the_first_and_the_last(tmp_path: Path) -> None:
    """PT3: 0.02 px an image."""
    plain = texture()
    still = write_fixed(tmp_path / "still", lambda c, t: noisy(plain, 0.02, t), times=60)
    drifting = write_fixed(tmp_path / "drift", lambda c, t: noisy(shifted(plain, 0.02 * t), 0.02, t), times=60)
    assert ratio(still) <= 1 < ratio(drifting)


def test_a_motion_with_the_period_of_the_sampling_is_found(tmp_path: Path) -> None:
    """PT4: of 256 images every fourth would be looked at, and shows the same."""
    plain = texture(32)
    folder = write_fixed(tmp_path, lambda c, t: shifted(plain, 2.0 * (t % 4 == 2)), times=256, size=32)
    found = statistics_of(folder)
    assert found.examined <= MAX_IMAGES
    assert found.change is not None
    assert found.change.ratio > 1


def test_pictures_of_several_heights_are_of_several_cameras(tmp_path: Path) -> None:
    lens = {"fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 9.0, "w": 32}
    frames = []
    for index in range(6):
        name, height = f"train/{index}", 16 + index // 2
        write_image(tmp_path / f"{name}.png", np.full((height, 32, 3), 40 * index, np.uint8))
        frames.append(entry(orbit(0, 4), name, index / 5, **lens, h=height))
    write_transforms(tmp_path, "train", frames)
    found = statistics_of(tmp_path)
    assert found.cameras == 3


def test_a_moving_camera_tells_nothing_about_motion(tmp_path: Path) -> None:
    """PT5."""
    found = statistics_of(write_synthetic(tmp_path / "c", frames=8, size=24))
    assert found.camera_motion == "moving"
    assert found.change is None
    assert found.gain is None


def test_exposure_is_not_taken_for_motion(tmp_path: Path) -> None:
    """PT6: a gain of 3 %."""
    plain, random = texture(), np.random.default_rng(3)
    gains = 1 + 0.03 * random.uniform(-1, 1, 12)
    found = statistics_of(write_fixed(tmp_path, lambda c, t: noisy(gains[t] * plain, 0.01, t), times=12))
    assert found.change is not None
    assert found.change.ratio <= 1
    assert found.gain is not None
    assert found.gain == pytest.approx((gains.min() / np.median(gains), gains.max() / np.median(gains)), abs=0.01)


def test_what_only_the_second_camera_sees_move_is_found(tmp_path: Path) -> None:
    """PT7."""
    plain = texture()

    def draw(camera: int, index: int) -> np.ndarray:
        return square(plain, 10 + 3 * index, 20, 8, (1, 0, 0)) if camera == 1 else plain

    found = statistics_of(write_fixed(tmp_path, draw, cameras=2)).change
    assert found is not None
    assert found.ratio > 1
    assert found.image.startswith("train/c1_")


def test_a_moving_shadow_changes_tiles(tmp_path: Path) -> None:
    """PT8: whether it is light or an object cannot be told from the images, so both parts stay."""
    plain = texture()

    def draw(camera: int, index: int) -> np.ndarray:
        shaded = plain.copy()
        shaded[:, 6 * index : 6 * index + 10] *= 0.8
        return shaded

    assert ratio(write_fixed(tmp_path, draw)) > 1


def test_a_shaking_camera_is_motion(tmp_path: Path) -> None:
    """PT9: 0.3 px, which poses without noise do not tell."""
    plain, random = texture(), np.random.default_rng(5)
    shakes = random.normal(0, 0.3, 10)
    assert ratio(write_fixed(tmp_path, lambda c, t: shifted(plain, shakes[t] + 2), times=10)) > 1


@pytest.mark.parametrize(
    ("channel", "alpha"), [(None, "absent"), (np.ones((64, 64, 1)), "opaque"), (np.zeros((64, 64, 1)), "varying")]
)
def test_the_kind_of_alpha(tmp_path: Path, channel: np.ndarray | None, alpha: str) -> None:
    """An image with alpha 0 everywhere says that space is empty there: PT15."""

    def draw(camera: int, index: int) -> np.ndarray:
        if channel is None:
            return texture()
        return np.concatenate([texture(), channel if index == 3 else np.ones((64, 64, 1))], axis=-1)

    assert statistics_of(write_fixed(tmp_path, draw)).alpha == alpha


def test_points_and_lenses_are_counted(tmp_path: Path) -> None:
    capture = load_capture(write_colmap(tmp_path), CaptureConfig())
    found = measure(capture, ImageStore(WHITE), WHITE)
    assert (found.points, found.distorted, found.alpha) == (40, 0, "absent")
    bent = write_colmap(tmp_path / "bent", model="SIMPLE_RADIAL", params=(30.0, 15.5, 10.5, 0.02))
    capture = load_capture(bent, CaptureConfig())
    assert measure(capture, ImageStore(WHITE), WHITE).distorted == len(capture.train)


def test_detail_and_coverage_are_shares_of_the_pixels(tmp_path: Path) -> None:
    white = np.ones((64, 64, 3))
    found = statistics_of(write_fixed(tmp_path, lambda c, t: square(white, 8, 8, 16, (0, 0, 0))))
    assert found.coverage == pytest.approx(16 * 16 / 64**2)
    assert found.detail == pytest.approx((4 * 16 + 1) / 64**2, rel=0.05)


def test_a_sample_has_both_ends_of_every_camera_and_is_always_the_same(tmp_path: Path) -> None:
    capture = load_capture(write_fixed(tmp_path, lambda c, t: texture(16), cameras=5, times=30, size=16))
    groups = _cameras(capture.train)

    def names(frames: list[Frame]) -> set[str]:
        return {frame.name for frame in frames}

    chosen = names(_sample(groups, 40))
    assert len(chosen) == 40
    assert {f"train/c{camera}_{index:03d}.png" for camera in range(5) for index in (0, 29)} <= chosen
    assert names(_sample(groups, 40)) == chosen
    assert len(names(_sample(groups, 1_000))) == 150
