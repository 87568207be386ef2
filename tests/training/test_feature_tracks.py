"""Tracks of what crosses a video, from the features of its frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from graings.camera.camera import Camera
from graings.capture.capture import Capture
from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.config import TrainConfig
from graings.training.run import TrainingRun
from graings.training.tracks import feature_tracks as module
from graings.training.tracks.feature_tracks import feature_tracks
from graings.training.tracks.moving_features import FeatureMotion, MovingFeatures, shift_at_rest
from tests.training.micro import micro_config
from tests.training.video import HALF, camera, off_board, on_board, write_video

TRAVEL = 1.2
STEPS = 1000  # long enough for a restart


@pytest.fixture(scope="module")
def crossed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("crossed"), TRAVEL)


def config(**options: object) -> TrainConfig:
    return micro_config(**{"iterations": STEPS, **options})


def images() -> ImageStore:
    return ImageStore((1.0, 1.0, 1.0))


def test_points_follow_the_board_and_nothing_else(crossed: Path) -> None:
    capture = load_capture(crossed)
    tracks = feature_tracks(capture, images(), config())
    assert tracks is not None
    points = np.stack([capture.units.points_back(at) for at in tracks.positions.double().numpy()])
    times = [capture.units.time_start + capture.units.time_span * time for time in tracks.times.tolist()]
    middle = len(times) // 2

    def seen(at: np.ndarray, time: float) -> np.ndarray:
        return camera(time).project(at)[0]

    # The floor's depth is too far for them, so they are compared where a camera sees them.
    places = off_board(_on_height(points[middle], times[middle]), times[middle], TRAVEL)
    assert (np.abs(places) < HALF + 0.05).all(axis=1).mean() > 0.95
    assert len(places) >= 100
    misses = [
        np.linalg.norm(seen(at, t) - seen(on_board(places, t, TRAVEL), t), axis=1)
        for at, t in zip(points, times, strict=True)
    ]
    way = np.linalg.norm(seen(points[0], times[0]) - seen(points[-1], times[-1]), axis=1)
    print(f"median miss {[round(float(np.median(miss)), 2) for miss in misses]} of {np.median(way):.0f} px")
    assert np.median(way) > 80
    assert max(np.median(miss) for miss in misses) < 4
    resting = capture.units.points_back(tracks.rest.double().numpy())
    assert np.abs(resting[:, 2]).max() < 1e-6


def _on_height(points: np.ndarray, time: float) -> np.ndarray:
    """Where the rays to points [N, 3] pass the board's height."""
    eye = camera(time).center
    towards = points - eye
    return eye + (0.15 - eye[2]) / towards[:, 2:] * towards


def test_the_same_tracks_come_again(crossed: Path) -> None:
    one, other = (feature_tracks(load_capture(crossed), images(), config()) for _ in range(2))
    assert one is not None
    assert other is not None
    for name, tensor in one.tensors().items():
        torch.testing.assert_close(tensor, other.tensors()[name], rtol=0, atol=0)


@pytest.mark.parametrize("paint", [True, False], ids=["at rest", "without features"])
def test_where_nothing_is_seen_to_move_there_are_no_tracks(tmp_path: Path, paint: bool) -> None:
    capture = load_capture(write_video(tmp_path, 0.0 if paint else TRAVEL, paint=paint))
    assert feature_tracks(capture, images(), config()) is None


def without_points(capture: Capture) -> Capture:
    return replace(capture, points=None)


def at_one_time(capture: Capture) -> Capture:
    return replace(capture, train=tuple(replace(frame, time=0.5) for frame in capture.train))


def far_apart(capture: Capture) -> Capture:
    """Cameras that jump: no video."""
    jumps = [camera(0.5).world_to_camera, camera(0.5).world_to_camera.copy()]
    jumps[1][0, 3] += 0.5
    units = capture.units
    moved = [
        replace(f, camera=replace(f.camera, world_to_camera=units.camera(jumps[i % 2])))
        for i, f in enumerate(capture.train)
    ]
    return replace(capture, train=tuple(moved))


@pytest.mark.parametrize("change", [without_points, at_one_time, far_apart])
def test_what_is_no_video_has_no_tracks(crossed: Path, change: object) -> None:
    assert callable(change)
    assert feature_tracks(change(load_capture(crossed)), images(), config()) is None


@pytest.mark.parametrize(
    "options",
    [{"iterations": 100}, {"time_window": 1.0}, {"scene.deformation": "none"}, {"scene.single_mlp": True}],
)
def test_a_run_that_cannot_use_tracks_does_not_look_for_them(
    crossed: Path, options: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MovingFeatures", None)  # whoever looked would fail
    assert feature_tracks(load_capture(crossed), images(), config(**options)) is None


def test_tracks_that_disagree_with_matches_over_several_frames_are_refused(
    crossed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As features that repeat along an object do: each step seems to go on, and the object stays."""
    true = module.MovingFeatures.between

    def between(self: module.MovingFeatures, one: int, other: int) -> FeatureMotion:
        motion = true(self, one, other)
        return (
            motion
            if other - one == 1
            else FeatureMotion(motion.start, motion.start + 0.3 * (motion.end - motion.start))
        )

    monkeypatch.setattr(module.MovingFeatures, "between", between)
    assert feature_tracks(load_capture(crossed), images(), config()) is None


def test_a_point_goes_on_while_no_feature_is_near() -> None:
    start = np.random.default_rng(0).normal(size=(50, 3)) * 0.1
    motion = FeatureMotion(start, start + np.array([0.1, 0.0, 0.0]))
    nothing = FeatureMotion(start[:0], start[:0])
    elsewhere = FeatureMotion(start + 5.0, start + 5.2)
    steps = module._steps(np.zeros((1, 3)), [motion, nothing, elsewhere])
    np.testing.assert_allclose(np.concatenate(steps), [[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]], atol=1e-9)
    still = module._steps(np.full((1, 3), 9.0), [motion])
    np.testing.assert_array_equal(still[0], np.full((1, 3), 9.0))


def test_a_point_takes_part_in_the_turn_of_the_features_around_it() -> None:
    random = np.random.default_rng(1)
    start = random.normal(size=(60, 3))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    end = start @ turn.T + [0.0, 0.0, 2.0]
    end[::12] += random.normal(size=(5, 3))  # wrong matches
    point = np.array([[0.3, -0.2, 0.1]])
    np.testing.assert_allclose(
        module._steps(point, [FeatureMotion(start, end)])[0], point @ turn.T + [0, 0, 2], atol=0.02
    )


def test_a_frame_that_sees_no_point_has_no_moving_features(crossed: Path) -> None:
    capture = load_capture(crossed)
    behind = capture.train[0].camera.center - capture.train[0].camera.forward
    moving = MovingFeatures(capture.train[:2], images(), behind[None])
    assert len(moving.between(0, 1).start) == 0


def test_a_dense_cloud_gives_the_same_depths_in_little_memory(crossed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = load_capture(crossed)
    camera = capture.train[0].camera
    pixels = np.random.default_rng(0).random((200_000, 2)) * [camera.width, camera.height]
    ahead = np.stack([(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy], axis=1)
    depth = 2.0 + 0.5 * pixels[:, :1] / camera.width
    cloud = np.concatenate([ahead * depth, depth], axis=1) @ camera.world_to_camera[:3, :3] + camera.center
    sizes: list[int] = []
    cdist = torch.cdist
    monkeypatch.setattr(torch, "cdist", lambda a, b: sizes.append(len(b)) or cdist(a, b))
    moving = MovingFeatures(capture.train[:2], images(), cloud)
    depths = moving._depths(0)
    columns = (np.arange(depths.shape[1]) + 0.5) / depths.shape[1]
    np.testing.assert_allclose(depths, np.broadcast_to(2.0 + 0.5 * columns, depths.shape), atol=0.02)
    assert sizes == [10_000]


def test_the_shift_of_points_is_a_part_of_the_image() -> None:
    one = Camera(np.eye(4), 100.0, 100.0, 50.0, 25.0, 100, 50)
    pose = np.eye(4)
    pose[0, 3] = 0.2
    other = replace(one, world_to_camera=pose)
    rest = np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.0, 0.0, -2.0]])
    assert shift_at_rest(one, other, rest) == pytest.approx(0.1)  # 10 px
    assert shift_at_rest(one, other, rest[2:]) == np.inf


def test_a_run_begins_with_the_tracks_and_says_so(crossed: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(crossed, tmp_path / "run", config(**{"init.max_points": 200}))
    first = next(iter(run))
    (found,) = [event for event in first.events if event.kind == "motion"]
    assert run.trainer.tracks is not None
    assert found.tracked_points == len(run.trainer.tracks.points)
    assert first.phase == "joint"  # no static phase
    run.save()
    again = TrainingRun.resume(run.folder)
    assert again.trainer.tracks is not None
    torch.testing.assert_close(again.trainer.tracks.positions, run.trainer.tracks.positions, rtol=0, atol=0)
    assert next(iter(again)).phase == "joint"
