"""A fast scene is within its bound in any view: approximate where the view does not magnify the error, else exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from graings.camera.camera import Camera
from graings.render import render
from graings.scene.fast_scene import MOST_PIXELS, FastScene
from graings.scene.motion_signals import pixels_per_unit
from graings.scene.prepared import PreparedScene
from tests.scene.test_motion_basis import VIEWS
from tests.scene.test_prepared import scene_of


@pytest.fixture(scope="module")
def fast() -> FastScene:
    """Its motion has an error of 0.2 px in the training views."""
    made = FastScene.of(PreparedScene(scene_of({})), VIEWS)
    report = made.report
    error = report.geometry.error.model_copy(update={"p99": 0.2})
    return replace(
        made, report=report.model_copy(update={"geometry": report.geometry.model_copy(update={"error": error})})
    )


def test_a_training_view_is_approximate_and_a_view_ten_times_as_near_is_exact(fast: FastScene) -> None:
    """PT10 of the numerics notes: a bound in px of the training views says nothing about a camera that is nearer."""
    middle = fast._positions.mean(0)
    training = VIEWS[3].camera
    near = Camera.orbit(111.0, 20.0, 0.3, fov=0.9, width=200, height=150, target=tuple(middle))
    assert fast.seen_by(training) is fast.approximate
    assert fast.line(training) == fast.report.line
    assert fast.error(near) > MOST_PIXELS
    assert fast.seen_by(near) is fast.exact
    assert fast.line(near).startswith("exact")
    images = [render(scene, near, 0.3, (1.0, 1.0, 1.0)).color for scene in (fast.seen_by(near), fast.exact)]
    assert torch.equal(*images)


@pytest.mark.parametrize("factor", [1, 2, 3, 10])
def test_more_pixels_magnify_the_error_as_much(fast: FastScene, factor: int) -> None:
    camera = VIEWS[3].camera
    larger = camera.resized(factor * camera.width, factor * camera.height)
    assert fast.error(larger) == pytest.approx(factor * fast.error(camera))
    assert (fast.seen_by(larger) is fast.exact) == (fast.error(larger) > MOST_PIXELS)


def test_the_error_of_a_view_that_shows_no_sample_is_not_known_unless_all_that_moves_is_one(fast: FastScene) -> None:
    away = Camera.orbit(0.0, 0.0, 3.0, fov=0.9, width=200, height=150, target=(0.0, -40.0, 0.0))
    assert not pixels_per_unit(away, fast._positions).any()
    assert fast.report.geometry.children == len(fast._rates)
    assert fast.error(away) == 0
    some = replace(fast, _positions=fast._positions[::2], _rates=fast._rates[::2])
    assert some.seen_by(away) is some.exact


def test_without_motion_every_view_is_approximate() -> None:
    scene = scene_of({})
    scene.temporal = False
    still = FastScene.of(PreparedScene(scene), VIEWS)
    assert still.report.geometry.rank == 0
    assert still.error(VIEWS[0].camera) == 0
    assert still.seen_by(VIEWS[0].camera) is still.approximate


def test_pixels_per_unit_are_how_far_a_small_step_moves_in_the_image() -> None:
    camera = VIEWS[2].camera
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    rates = pixels_per_unit(camera, points)
    steps = np.random.default_rng(1).normal(size=(200, 3))
    steps *= 1e-5 / np.linalg.norm(steps, axis=1, keepdims=True)
    before = camera.project(points)[0]
    moved = np.stack([np.linalg.norm(camera.project(points + step)[0] - before, axis=1) for step in steps]) / 1e-5
    assert (moved.max(0) <= 1.001 * rates).all()
    assert (moved.max(0) >= 0.9 * rates).all()
