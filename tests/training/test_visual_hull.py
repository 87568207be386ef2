"""Which points the images allow, and for how much of the clip."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from statistics import mean

import numpy as np
import pytest

from graings.capture.capture import Capture, PointCloud
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic import Array, Body, SyntheticScene, write_synthetic
from graings.config import TrainConfig, make_config
from graings.random import RandomStreams
from graings.training.density.budget import affordable_anchors
from graings.training.initialization.initial_scene import initial_points
from graings.training.initialization.visual_hull import MIN_COVERAGE, MIN_POINTS, coverage, masked, visual_hull
from tests.capture.captures import without_alpha, write_image
from tests.training.micro import GROWING, events_of, micro_trainer, quality, steps

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture
def large_motion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small ball that moves to and fro, three times its own width, and turns around at the middle of the clip."""
    ball = _ball(np.zeros(3), np.array([0.8, 0.3, 0.0]), 0.24)
    monkeypatch.setattr(SyntheticScene, "random", staticmethod(lambda *_: SyntheticScene((ball,))))
    return write_synthetic(tmp_path / "large_motion", frames=48, size=40)


@pytest.fixture
def accompanied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A large ball that stays in the middle, and well above it a small one that moves to and fro."""
    still = _ball(np.zeros(3), np.zeros(3), 0.5)
    small = _ball(np.array([0.0, 0.0, 0.9]), np.array([0.8, 0.3, 0.0]), 0.2)
    monkeypatch.setattr(SyntheticScene, "random", staticmethod(lambda *_: SyntheticScene((still, small))))
    return write_synthetic(tmp_path / "accompanied", frames=48, size=40)


def _ball(home: Array, swing: Array, radius: float) -> Body:
    """A red ball that is farthest along its swing at the ends of the clip, and farthest back at its middle."""
    return Body(
        home=home,
        swing=swing,
        semi_axes=np.full(3, radius),
        axis=np.array([0.0, 0.0, 1.0]),
        colors=np.array([[0.8, 0.1, 0.1], [0.3, 0.1, 0.1]]),
        phases=np.full(6, math.pi / 2),
    )


def _draft(**options: object) -> TrainConfig:
    """A draft that begins with every point that the images allow, whatever memory that takes."""
    every = {"init.points": 60_000, "init.max_points": 60_000, "density.memory_mb": 100_000}
    return make_config("draft", {**every, **options})


def _found(capture: Path, config: TrainConfig) -> tuple[int, float]:
    data = load_capture(capture, config.capture)
    first = initial_points(data, ImageStore(WHITE), config, RandomStreams(0))
    return len(first.positions), first.time_window


def test_a_clip_with_large_motion_begins_with_a_part_of_it(large_motion: Path) -> None:
    count, window = _found(large_motion, _draft())
    assert 0.1 <= window < 1
    assert 100 <= count < 6_000  # of 60 000
    assert _found(large_motion, _draft(time_window=1.0)) == (60_000, 1.0)


@pytest.mark.slow(reason="carves 240 000 points several times")
def test_the_number_of_initial_anchors_is_limited(large_motion: Path) -> None:
    every, _ = _found(large_motion, _draft())
    assert _found(large_motion, _draft(**{"init.max_points": 50}))[0] == 50 < every
    data = load_capture(large_motion)
    cloud = replace(data, points=PointCloud(_grid(), np.zeros_like(_grid(), np.float32)))
    for capture in (data, cloud):
        points, few = (
            initial_points(capture, ImageStore(WHITE), _draft(**{"init.max_points": most}), RandomStreams(0)).positions
            for most in (60_000, 50)
        )
        assert len(few) == 50
        assert {tuple(place) for place in few.tolist()} < {tuple(place) for place in points.tolist()}
        # Points of a cloud lie on surfaces and stay: no more than may grow. Carved ones lie inside of things and go.
        tight = _draft(**{"density.max_anchors": 100})
        most = initial_points(capture, ImageStore(WHITE), tight, RandomStreams(0)).positions
        assert len(most) == (100 if capture is cloud else every)


def _small_ball(folder: Path, monkeypatch: pytest.MonkeyPatch, swing: float = 0.0) -> Capture:
    """A ball, at rest or swinging, of which 20 000 random points hit next to nothing."""
    ball = _ball(np.array([0.6, 0.0, 0.3]), np.array([0.0, swing, 0.0]), 0.1)
    monkeypatch.setattr(SyntheticScene, "random", staticmethod(lambda *_: SyntheticScene((ball,))))
    return load_capture(write_synthetic(folder, frames=32, size=64))


@pytest.mark.parametrize("window", [None, 0.25])
def test_of_a_small_object_that_moves_far_there_are_points_in_a_part_of_the_clip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, window: float | None
) -> None:
    data = _small_ball(tmp_path / "small", monkeypatch, swing=0.8)
    config = _draft(**{"init.points": 20_000, "time_window": window})
    first = initial_points(data, ImageStore(WHITE), config, RandomStreams(0))
    assert MIN_POINTS < len(first.positions) < 20_000
    assert first.time_window < 1
    assert first.notes == ()


def test_of_a_small_object_there_are_points_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = _small_ball(tmp_path / "small", monkeypatch)
    config = _draft(**{"init.points": 20_000})
    first = initial_points(data, ImageStore(WHITE), config, RandomStreams(0))
    assert MIN_POINTS < len(first.positions) < 20_000
    assert (first.time_window, first.notes) == (1.0, ())
    away = np.linalg.norm(data.units.points_back(first.positions) - np.array([0.6, 0.0, 0.3]), axis=1)
    assert float(np.quantile(away, 0.9)) < 0.25


def test_cameras_that_do_not_fit_the_masks_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = _small_ball(tmp_path / "small", monkeypatch)
    cameras = [frame.camera for frame in data.train]
    turned = [replace(frame, camera=cameras[(3 * k + 5) % len(cameras)]) for k, frame in enumerate(data.train)]
    first = initial_points(
        replace(data, train=tuple(turned)), ImageStore(WHITE), _draft(**{"init.points": 5_000}), RandomStreams(0)
    )
    assert len(first.positions) == 5_000
    (note,) = first.notes
    assert (note.source, note.triangulated) == ("random", None)
    assert note.within_masks is not None
    assert note.within_masks < MIN_POINTS
    assert f"only {note.within_masks} of those in view" in note.message
    assert "check the cameras, or raise init.points" in note.message


def test_first_anchors_fit_into_the_memory_wherever_they_come_from(large_motion: Path) -> None:
    data = load_capture(large_motion)
    cloud = replace(data, points=PointCloud(_grid(), np.zeros_like(_grid(), np.float32)))
    for capture, options in ((data, {}), (cloud, {}), (data, {"init.min_mask_fraction": 0.0})):
        config = _draft(**{"init.points": 20_000, "density.memory_mb": 4, **options})
        affordable = affordable_anchors(config.scene, config.batch, 4)
        assert affordable < config.density.max_anchors
        assert len(initial_points(capture, ImageStore(WHITE), config, RandomStreams(0)).positions) == affordable


def test_a_clip_with_small_motion_begins_as_a_whole(tmp_path: Path) -> None:
    capture = write_synthetic(tmp_path / "c", seed=1, frames=24, size=40)
    for options in ({}, {"time_window": 1.0}):
        count, window = _found(capture, _draft(**options))
        assert (count < 30_000, window) == (True, 1.0)


@pytest.mark.slow(reason="compares the quality of six trainings of 400 steps")
def test_an_object_with_large_motion_is_found(large_motion: Path) -> None:
    gains = []
    for seed in range(3):  # they lie a decibel apart
        found = []
        for options in ({}, {"time_window": 1.0}):
            few = {"iterations": 400, "seed": seed, "init.points": 20_000}
            trainer = micro_trainer(large_motion, **few, **GROWING, **options)
            reports = steps(trainer, 400)
            assert len(events_of(reports[:1], "time_window")) == (0 if options else 1)
            assert events_of(reports[1:], "time_window") == []
            found.append(quality(trainer))
        print(f"seed {seed}: by itself {found[0]:.2f} dB, the whole clip from the start {found[1]:.2f} dB")
        gains.append(found[0] - found[1])
    assert mean(gains) > 2


def test_a_window_with_too_few_views_is_not_tried(large_motion: Path) -> None:
    config = make_config("draft")
    data = load_capture(large_motion, config.capture)
    few = replace(data, train=data.train[::4])
    assert initial_points(few, ImageStore(WHITE), config, RandomStreams(0)).time_window == 1.0


@pytest.mark.parametrize("window", [None, 0.25])
def test_a_clip_whose_middle_is_empty_is_not_refused(large_motion: Path, window: float | None) -> None:
    for frame in load_capture(large_motion).train:
        if abs(frame.time - 0.5) < 0.3:
            write_image(frame.image_path, np.zeros((40, 40, 4), np.uint8))
    assert _found(large_motion, _draft(time_window=window)) == (60_000, window or 1.0)


def test_background_pixels_get_no_points(large_motion: Path) -> None:
    data = load_capture(large_motion)
    red, none = (masked(data.train[:4], ImageStore(colour), colour) for colour in (WHITE, (0.0, 0.0, 0.0)))
    for one, other in zip(red, none, strict=True):
        alpha = ImageStore(WHITE).alpha(one.frame)
        assert alpha is not None
        assert np.array_equal(one.mask, alpha > 0.5)
        assert np.array_equal(one.mask, other.mask)
    row, column = (int(index[0]) for index in red[0].mask.nonzero())
    own = ImageStore(WHITE).rgb(data.train[0])[row, column].tolist()
    assert masked(data.train[:1], ImageStore(WHITE), own)[0].mask.sum() < red[0].mask.sum()


def test_masks_without_alpha_exclude_the_background_colour(large_motion: Path) -> None:
    transparent = load_capture(large_motion).train[:4]
    ours = masked(transparent, ImageStore(WHITE), WHITE)
    without_alpha(large_motion)
    flat = load_capture(large_motion).train[:4]
    for one, other in zip(ours, masked(flat, ImageStore(WHITE), WHITE), strict=True):
        assert (one.mask & ~other.mask).sum() == 0  # a rim that is half there counts too
        assert one.mask.sum() <= other.mask.sum() < 2 * one.mask.sum() < one.mask.size / 5
    assert all(view.mask.all() and view.opaque for view in masked(flat, ImageStore(WHITE), (0.0, 0.0, 1.0)))


@pytest.mark.slow(reason="carves 240 000 points several times")
def test_without_alpha_the_same_points_and_window_are_chosen(large_motion: Path) -> None:
    count, window = _found(large_motion, _draft())
    without_alpha(large_motion)
    flat, same = _found(large_motion, _draft())
    assert same == window
    assert count <= flat < 1.5 * count


def test_images_of_background_only_keep_all_points(large_motion: Path) -> None:
    for frame in load_capture(large_motion).train:
        write_image(frame.image_path, np.full((40, 40, 3), 255, np.uint8))
    assert _found(large_motion, _draft()) == (60_000, 1.0)


def test_points_inside_the_ball_are_kept_and_cover_it(large_motion: Path) -> None:
    data = load_capture(large_motion)
    views = masked(data.train[20:28], ImageStore(WHITE), WHITE)
    kept = visual_hull(_grid(), views, 0.6, 50)
    assert 0 < len(kept) < 0.05 * len(_grid())
    assert coverage(kept, views, 50) > MIN_COVERAGE
    assert coverage(kept + 5, views, 50) == 0
    assert coverage(kept[:1], views, 50) < coverage(kept, views, 50)


def test_a_static_object_gets_a_tight_hull_and_a_moving_one_keeps_its_points(accompanied: Path) -> None:
    data = load_capture(accompanied)
    views = masked(data.train[16:32], ImageStore(WHITE), WHITE)
    found = []
    for points in (
        visual_hull(_grid(), views, 0.6, 1),
        visual_hull(_grid(), views, 0.6, 50),
    ):  # every point is near to one cell
        fog = np.linalg.norm(data.units.points_back(points), axis=-1) > 0.7  # the ball that stays has a radius of 0.5
        found.append((int(fog.sum()), len(points), coverage(points, views, 50)))
    (_, _, bare), (fog_left, count, covered) = found
    assert bare < 0.8 < 0.95 < covered
    assert fog_left < 0.1 * count


def test_a_hull_of_few_points_keeps_all_of_them(large_motion: Path) -> None:
    data = load_capture(large_motion)
    views = masked(data.train[20:28], ImageStore(WHITE), WHITE)
    many, few = (len(visual_hull(_grid()[::step], views, 0.6, 50)) * step for step in (1, 8))
    assert few >= 8 * MIN_POINTS
    assert few > 1.5 * many


def test_a_small_component_without_points_lowers_the_coverage(accompanied: Path) -> None:
    data = load_capture(accompanied)
    places = data.units.points_back(_grid())
    large = np.linalg.norm(places, axis=-1) < 0.5
    small = np.linalg.norm(places - (0.8, 0.3, 0.9), axis=-1) < 0.2  # where it is at the ends of the clip
    ends = masked([data.train[0], data.train[-1]] * 20, ImageStore(WHITE), WHITE)
    middle = masked(data.train[24:25], ImageStore(WHITE), WHITE)
    assert coverage(_grid()[large | small], ends, 50) > 0.9
    assert coverage(_grid()[large], ends, 50) == 0
    assert coverage(_grid()[large | small], middle, 50) == 0
    assert coverage(_grid()[large | small], ends + middle, 50) > 0.9  # one of many views may be wrong
    assert coverage(_grid()[large | small], ends[:4] + middle, 50) < MIN_COVERAGE


@pytest.mark.slow(reason="carves 240 000 points several times")
def test_a_small_object_with_large_motion_shortens_the_window(accompanied: Path) -> None:
    for seed in range(3):
        data = load_capture(accompanied)
        assert initial_points(data, ImageStore(WHITE), make_config("draft"), RandomStreams(seed)).time_window < 1


def _grid() -> Array:
    """Places [64000, 3] all over what the cameras see."""
    return np.stack(np.meshgrid(*[np.linspace(-0.36, 0.36, 40)] * 3), axis=-1).reshape(-1, 3)
