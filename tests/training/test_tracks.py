"""Tracks of content with large motion, from where a model differs from its images."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from graings.camera.camera import Camera
from graings.capture.capture import Frame
from graings.training.curriculum.restart import RestartState
from graings.training.objective import Objective
from graings.training.tracks.frame_residual import FrameResidual
from graings.training.tracks.motion_tracks import MotionTracks, find_tracks
from graings.training.tracks.track_loss import UNTIL, track_loss
from tests.training.micro import micro_config, micro_trainer

SIZE = 64
Way = Callable[[float], Sequence[float]]


def camera(azimuth: float, elevation: float) -> Camera:
    """At distance 4 from the origin, which it looks at; angles in degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    back = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    right = np.array([-math.sin(a), math.cos(a), 0.0])
    down = np.cross(-back, right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, down, -back])
    pose[:3, 3] = pose[:3, :3] @ (-4 * back)
    return Camera(pose, SIZE * 1.4, SIZE * 1.4, SIZE / 2, SIZE / 2, SIZE, SIZE)


def residual(balls: Sequence[tuple[Way, float]], view: Camera, time: float, masked: bool = False) -> FrameResidual:
    """A view that differs from its image where `balls` (way of the centre, radius) are."""
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = (
        np.stack([(u - view.cx) / view.fx, (v - view.cy) / view.fy, np.ones_like(u)], -1) @ view.world_to_camera[:3, :3]
    )
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    differs = np.zeros((SIZE, SIZE), np.bool_)
    for way, radius in balls:
        to = np.array(way(time)) - view.center
        differs |= np.linalg.norm(np.cross(rays, to), axis=-1) < radius
    seen = np.full_like(differs, not masked)
    frame = Frame("", view, time, Path(), (SIZE, SIZE))
    return FrameResidual(frame, False, differs & seen, seen, 1)


def circle(radius: float, height: float = 0.0, start: float = 0.0) -> Way:
    return lambda t: (
        radius * math.cos(2 * math.pi * (t + start)),
        radius * math.sin(2 * math.pi * (t + start)),
        height,
    )


def residuals(balls: Sequence[tuple[Way, float]], frames: int = 60, spread: float = 137.5) -> list[FrameResidual]:
    """Views one after the other in time, turned by `spread` degrees each."""
    views = [camera(spread * index, 25 + spread / 7 * math.sin(index)) for index in range(frames)]
    return [residual(balls, view, index / (frames - 1)) for index, view in enumerate(views)]


def tracks_of(found: Sequence[FrameResidual], anchors: NDArray[np.float64] | None = None) -> MotionTracks | None:
    rest = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1
    return find_tracks(
        found, 1.3, rest if anchors is None else torch.from_numpy(anchors), torch.Generator().manual_seed(0)
    )


def test_a_ball_on_a_circle_is_followed_through_the_clip() -> None:
    way = circle(0.8)
    tracks = tracks_of(residuals([(way, 0.2)]))
    assert tracks is not None
    assert len(tracks.times) == 56  # hulls of five views
    truth = torch.tensor([way(float(time)) for time in tracks.times])
    assert (tracks.positions.mean(1) - truth).norm(dim=-1).max() < 0.1
    # The points are those of the ball in the middle of the clip, to the width of a hull of five views.
    assert (tracks.points - torch.tensor(way(0.5))).norm(dim=-1).max() < 0.45
    nearest = torch.cdist(tracks.rest, tracks.points).amin(1)
    assert len(tracks.rest) == 200
    assert nearest.min() > 0.02


@pytest.mark.parametrize("frames", [60, 80, 100])
def test_displacements_are_finite_at_every_time_of_the_clip(frames: int) -> None:
    """The first and the last views have the same hull, whose time must not be there twice."""
    tracks = tracks_of(residuals([(circle(0.8), 0.2)], frames=frames))
    assert tracks is not None
    assert (tracks.times.diff() > 0).all()
    moments = [index / (frames - 1) for index in range(frames)]
    assert tracks.displacements(moments).isfinite().all()
    assert tracks.displacements(moments).norm(dim=-1).max() < 3.0  # the diameter of the circle is 1.6


def test_of_several_objects_those_that_go_far_are_followed_each_on_its_own_way() -> None:
    one, other = circle(0.8), circle(0.5, height=0.6, start=0.5)
    still: Way = lambda t: (0.0, 0.0, -0.7)  # noqa: E731
    trembling: Way = lambda t: (0.1 * math.sin(20 * t), 0.0, -0.1)  # noqa: E731
    tracks = tracks_of(residuals([(one, 0.2), (other, 0.25), (still, 0.2), (trembling, 0.15)], frames=120))
    assert tracks is not None
    first, second = (torch.tensor(way(0.5)) for way in (one, other))
    of_first = (tracks.points - first).norm(dim=-1) < (tracks.points - second).norm(dim=-1)
    for way, mine in ((one, of_first), (other, ~of_first)):
        truth = torch.tensor([way(float(time)) for time in tracks.times])
        assert mine.sum() > 20
        assert (tracks.positions[:, mine].mean(1) - truth).norm(dim=-1).max() < 0.15
    assert tracks.points[:, 2].min() > -0.35


@pytest.mark.parametrize(
    "found",
    [
        residuals([]),
        residuals([(lambda t: (0.3, 0.0, 0.0), 0.4)]),  # at rest
        residuals([(lambda t: (0.2 * t, 0.0, 0.0), 0.4)]),  # less than its size
        residuals([(lambda t: (0.0, 0.0, 0.0), 9.0)]),  # everywhere
        residuals([(circle(0.8), 0.2)], spread=0.5),  # a hand-held video: no depth
        residuals([(circle(0.8), 0.2)], frames=2)[:1],
        residuals([(circle(0.8), 0.2)])[:30:10],  # too far apart in time
        [residual([(circle(0.8), 0.2)], camera(137.5 * index, 30), index / 59, masked=True) for index in range(60)],
        [residual([(circle(0.8), 0.2)], camera(20 * index, 30), 0.5) for index in range(12)],  # one instant
    ],
    ids=["nothing", "rest", "near", "all", "video", "one", "sparse", "masked", "instant"],
)
def test_nothing_is_followed_that_does_not_go_far_or_cannot_be_placed(found: list[FrameResidual]) -> None:
    assert tracks_of(found) is None


def test_what_appears_for_a_short_time_is_not_followed() -> None:
    way = circle(0.8)
    brief: Way = lambda t: way(t) if t > 0.5 else (0.0, 0.0, 50.0)  # noqa: E731
    assert tracks_of(residuals([(brief, 0.2)])) is None


def test_displacements_are_linear_between_times_and_beyond_them() -> None:
    positions = torch.tensor([[[0.0, 0, 0]], [[1.0, 0, 0]], [[1.0, 2, 0]]])
    tracks = MotionTracks(torch.tensor([[1.0, 0, 0]]), torch.tensor([0.2, 0.4, 0.8]), positions, torch.zeros(0, 3))
    expected = [[-2, 0, 0], [-1, 0, 0], [-0.5, 0, 0], [0, 0, 0], [0, 1, 0], [0, 2, 0], [0, 3, 0]]
    moments = [0.0, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0]
    assert torch.allclose(tracks.displacements(moments)[:, 0], torch.tensor(expected, dtype=torch.float32), atol=1e-6)
    again = MotionTracks.of_tensors(tracks.tensors())
    assert again is not None
    assert all(torch.equal(value, again.tensors()[name]) for name, value in tracks.tensors().items())
    assert MotionTracks.of_tensors({}) is None


def moving_right() -> MotionTracks:
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    times = torch.linspace(0, 1, 5)
    shift = torch.tensor([1.0, 0, 0]) * (times - 0.5)[:, None, None]
    return MotionTracks(points, times, points + shift, points - 2)


def test_the_loss_draws_the_deformation_to_the_tracks_and_fades_out(micro: Path) -> None:
    trainer = micro_trainer(micro, iterations=100)
    scene, tracks, moments = trainer.scene, moving_right(), [0.0, 0.5, 1.0]
    optimizer = torch.optim.Adam(scene.deformation.parameters(), 1e-2)
    first = float(track_loss(scene, tracks, moments).detach())
    assert first == pytest.approx(1 / 6 / 3 * 1.0 / float(scene.extent), rel=1e-5)  # nothing moves at first
    for _ in range(200):
        optimizer.zero_grad()
        loss = track_loss(scene, tracks, moments)
        loss.backward()
        optimizer.step()
    assert float(loss.detach()) < 0.3 * first
    config = micro_config(iterations=100)
    objective = Objective(config, trainer.images, trainer.capture.times, trainer.streams, tracks)
    at = [float(objective._track_term(scene, moments, iteration).detach()) for iteration in (0, 25, 50, 100)]
    assert config.scaled(UNTIL) == 50
    assert at[0] > 0
    assert at[1:] == [pytest.approx(at[0] / 2), 0.0, 0.0]
    scene.deformation = None
    assert float(track_loss(scene, tracks, moments)) == 0.0


def test_a_restart_with_tracks_has_the_whole_clip_and_no_static_phase() -> None:
    config = micro_config()
    tracked = RestartState(100, 1.0, tracked=True).config(config)
    assert (tracked.time_window, tracked.warmup, tracked.iterations) == (1.0, 0, config.iterations)
