"""Units: lengths scaled by a power of two, times in [0, 1], the up axis."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from graings.camera.camera import Camera
from graings.capture.load import load_capture
from graings.capture.normalize import center_and_scale, up_axis
from graings.errors import CaptureError
from graings.inspection.inspect import inspect_capture
from tests.capture.captures import entry, orbit, pixels, write_dnerf, write_image, write_transforms

RADIUS = 4.25  # 17 / 4: the poses below stay exact when scaled


def ring(scale: float = 1.0, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[Camera]:
    cameras = [orbit(index, 7, radius=RADIUS) for index in range(7)]
    moved = []
    for camera in cameras:
        pose = np.array(camera.world_to_camera)
        pose[:3, 3] = (pose[:3, 3] - pose[:3, :3] @ np.array(offset)) * scale
        moved.append(Camera(pose, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height))
    return moved


def test_cameras_on_a_ring_centre_on_what_they_look_at() -> None:
    center, scale, notes = center_and_scale(ring(), None)
    np.testing.assert_allclose(center, 0.0, atol=1e-14)
    assert scale == 0.25
    assert notes == []


@pytest.mark.parametrize("exponent", [-13, -3, 3, 10, 17])
def test_capture_scaled_by_a_power_of_two_has_the_same_bits(exponent: int) -> None:
    factor = 2.0**exponent
    center, scale, _ = center_and_scale(ring(), None)
    scaled_center, scaled_scale, _ = center_and_scale(ring(factor), None)
    assert scaled_scale == scale / factor
    np.testing.assert_array_equal(scaled_center, center * factor)


@pytest.mark.parametrize(
    "radius", [math.sqrt(0.5), math.sqrt(2.0), np.nextafter(math.sqrt(2.0), 0), 1.0, 0.7, 1e-5, 1e5]
)
def test_scale_brings_the_radius_within_a_factor_of_root_two(radius: float) -> None:
    points = radius * np.concatenate([np.eye(3), -np.eye(3)])
    _, scale, _ = center_and_scale(ring(1e-9), points)
    assert 2**-0.5 * (1 - 1e-12) <= scale * radius <= 2**0.5 * (1 + 1e-12)


def test_far_from_the_origin_the_centre_follows() -> None:
    offset = (5e5, 4e6, 300.0)
    center, scale, _ = center_and_scale(ring(offset=offset), None)
    np.testing.assert_allclose(center, offset, atol=1e-8)  # float64 spacing at 4e6 is 9e-10
    assert scale == 0.25


def test_outliers_among_the_points_do_not_move_the_centre() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    points[:10] = 1e6
    center, scale, _ = center_and_scale(ring(), points)
    assert np.abs(center).max() < 0.3
    assert scale == 0.25


def test_one_camera_has_no_scale() -> None:
    camera = ring()[0]
    center, scale, notes = center_and_scale([camera] * 8, None)
    np.testing.assert_allclose(center, camera.center + camera.forward, atol=1e-15)
    assert scale == 1.0
    assert [note.partition(":")[0] for note in notes] == ["no_scale"]


def test_parallel_axes_have_no_parallax_but_keep_their_scale() -> None:
    cameras = []
    for x in (-3.0, -1.0, 1.0, 3.0):
        pose = np.eye(4)
        pose[0, 3] = -x
        cameras.append(Camera(pose, 10.0, 10.0, 5.0, 5.0, 10, 10))
    center, scale, notes = center_and_scale(cameras, None)
    np.testing.assert_allclose(center[:2], 0.0, atol=1e-15)
    assert center[2] > 0
    assert 0.1 < scale * 3.0 < 1.0
    assert [note.partition(":")[0] for note in notes] == ["no_parallax"]


def test_cameras_looking_outwards_are_centred_on_themselves() -> None:
    cameras = [
        Camera.look_at(point, 2 * point, fov=0.7, width=8, height=8)
        for point in (np.array([math.cos(a), math.sin(a), 0.0]) for a in np.arange(5) * 2 * math.pi / 5)
    ]
    center, _, notes = center_and_scale(cameras, None)
    assert np.linalg.norm(center) < 1.0
    assert notes == ["the cameras look outwards: the scene is centred on the cameras"]


def test_level_cameras_give_an_exact_up_axis() -> None:
    # Seen from one side only and from above, the mean camera up leans by far more than ten degrees.
    cameras = [Camera.orbit(a, 50.0, 4.0, fov=0.7, width=8, height=8) for a in (0.0, 20.0, 40.0)]
    assert up_axis(cameras) == (0.0, 0.0, 1.0)


@pytest.mark.parametrize("seed", range(20))
def test_cameras_with_parallel_right_axes_have_their_mean_up_axis(seed: int) -> None:
    """One camera, or several that differ in place and elevation only: rounding must not choose the axis."""
    generator = np.random.default_rng(seed)
    eye, azimuth = generator.normal(size=3) * 3, float(generator.uniform(0, 360))
    one = Camera.look_at(eye, (0, 0, 0), up=(0.0, 0.6, 0.8), fov=0.7, width=8, height=8)
    several = [Camera.orbit(azimuth, e, 4.0, fov=0.7, width=8, height=8) for e in (-30.0, 0.0, 45.0)]
    for cameras in ([one], [one] * 12, several):
        mean = np.mean([-camera.world_to_camera[1, :3] for camera in cameras], axis=0)
        assert np.array(up_axis(cameras)) @ mean / np.linalg.norm(mean) > math.cos(math.radians(10.1))


def test_cameras_that_look_at_each_other_centre_between_them() -> None:
    for axis in np.eye(3):
        ends = [np.array([1.0, 2.0, 3.0]) + sign * 3 * axis for sign in (1, -1)]
        up = np.roll(axis, 1)
        cameras = [
            Camera.look_at(eye, other, up=up, fov=0.7, width=8, height=8)
            for eye, other in zip(ends, ends[::-1], strict=True)
        ]
        center, scale, _ = center_and_scale(cameras, None)
        np.testing.assert_allclose(center, (1.0, 2.0, 3.0), atol=1e-12)
        assert scale == 0.25


def test_tilted_up_axis_is_kept() -> None:
    up = np.array([0.0, 0.6, 0.8])
    cameras = [Camera.orbit(a, 20.0, 4.0, up=up, fov=0.7, width=8, height=8) for a in range(0, 360, 30)]
    np.testing.assert_allclose(up_axis(cameras), up, atol=1e-12)


@pytest.mark.parametrize(
    "times",
    [
        [0.0, 0.5, 1.0],
        [5.0, 6.0, 9.0, 7.0],
        [-3.0, -1.5, -2.0],
        [1.7e9 + i / 30 for i in range(20)],
        [1.7e12 + 33 * i for i in range(20)],
    ],
    ids=["unit", "from five", "negative", "epoch seconds", "epoch milliseconds"],
)
def test_times_are_mapped_to_the_unit_interval_in_double_precision(tmp_path: Path, times: list[float]) -> None:
    capture = load_capture(write_dnerf(tmp_path, times))
    low, high = Fraction(min(times)), Fraction(max(times))
    for frame, time in zip(capture.train, times, strict=True):
        assert frame.time == pytest.approx(float((Fraction(time) - low) / (high - low)), abs=1e-12)
    assert len(capture.times) == len(times)
    assert capture.times[0] == 0.0
    assert capture.times[-1] == 1.0


def test_order_of_frames_does_not_change_their_times(tmp_path: Path) -> None:
    times = [0.3, 7.0, 1.1, 5.2]
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    forward = {frame.time for frame in load_capture(write_dnerf(tmp_path / "a", times)).train}
    assert {frame.time for frame in load_capture(write_dnerf(tmp_path / "b", times[::-1])).train} == forward


def test_times_closer_than_a_millionth_of_the_range_are_one_instant(tmp_path: Path) -> None:
    capture = load_capture(write_dnerf(tmp_path, [0.0, 1.0, 1.0 + 1e-9, 1.0, 2.0 - 1e-9, 2.0]))
    assert capture.times.tolist() == [0.0, pytest.approx(0.5, abs=1e-9), 1.0]


def test_chain_of_close_times_does_not_collapse(tmp_path: Path) -> None:
    for index in range(6):
        write_image(tmp_path / f"train/{index}.png", pixels(12, 12, seed=index))
    times = [0.0, 0.8e-6, 1.6e-6, 2.4e-6, 3.2e-6, 1.0]
    write_transforms(tmp_path, "train", [entry(orbit(i, 6), f"train/{i}", times[i]) for i in range(6)])
    write_transforms(tmp_path, "val", [])
    assert load_capture(tmp_path).times.tolist() == [0.0, 1.6e-6, 3.2e-6, 1.0]


def test_single_instant_is_time_zero(tmp_path: Path) -> None:
    capture = load_capture(write_dnerf(tmp_path, [5.0, 5.0, 5.0]))
    assert capture.times.tolist() == [0.0]
    assert capture.units.time_span == 0.0
    assert any("one time" in note for note in capture.notes)


@pytest.mark.parametrize("start", [0.0, 1_532_402_927.0, 1_532_402_927_647_951.0, 1_403_636_579_763_555_584.0])
@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
def test_times_since_1970_are_read_in_every_unit(tmp_path: Path, start: float, unit: float) -> None:
    """Clips as long as `unit`: refused where float64 stores their times in too coarse steps."""
    times = [start + unit * step / 4 for step in range(5)]
    capture = (tmp_path / "capture").resolve()
    if len(set(times)) == 1:
        assert load_capture(write_dnerf(capture, times)).times.tolist() == [0.0]
    elif start * 2.0**-52 > 1e-4 * unit:
        with pytest.raises(CaptureError, match=r"^train/r_00\d\.png, time: ") as caught:
            load_capture(write_dnerf(capture, times))
        assert "Subtract" in caught.value.remedy
    else:
        found = load_capture(write_dnerf(capture, times)).times
        np.testing.assert_allclose(found, np.arange(5) / 4, atol=1e-4)


@pytest.mark.parametrize("time", [1e200, -1e308])
def test_a_time_whose_differences_overflow_is_refused(tmp_path: Path, time: float) -> None:
    with pytest.raises(CaptureError, match=r"^train/r_001\.png, time: is -?1e\+\d+, beyond the limit of 1e\+100"):
        load_capture(write_dnerf(tmp_path, [0.0, time, 1.0]))


def test_times_of_one_instant_may_be_any_number(tmp_path: Path) -> None:
    assert load_capture(write_dnerf(tmp_path, [1.4e18] * 3)).times.tolist() == [0.0]


def test_long_times_are_printed_with_the_digits_that_differ(tmp_path: Path) -> None:
    start = 1_532_402_927_647_951
    found, _ = inspect_capture(write_dnerf(tmp_path, [start + 250_000.0 * step for step in range(5)]))
    (line,) = [line for line in found.lines() if line.startswith("times")]
    assert f"from {start} to {start + 1_000_000}" in line
