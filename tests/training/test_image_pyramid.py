"""Training that begins with downscaled images."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
import torch

from graings.camera.camera import Camera
from graings.capture.images import shrink
from graings.config import make_config
from graings.report.events import RolledBack
from graings.storage.compact import open_model
from graings.training.curriculum import resolution_schedule as resolution
from graings.training.curriculum.resolution_schedule import downscale_factor, downscaled
from graings.training.run import TrainingRun
from graings.training.trainer import Trainer
from tests.training.micro import events_of, micro_config, micro_trainer, steps


def _camera(width: int, height: int) -> Camera:
    return Camera(np.eye(4), 1.2 * width, 1.2 * width, 0.5 * width, 0.4 * height, width, height)


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [
        ([(400, 300)], [2, 2, 2, 2, 1, 1]),
        ([(800, 800)], [4, 4, 2, 2, 1, 1]),
        ([(90, 70), (300, 1_700)], [8, 8, 4, 2, 1, 1]),  # the largest counts
        ([(399, 399)], [1, 1, 1, 1, 1, 1]),
    ],
)
def test_the_resolution_doubles_at_even_intervals(sizes: list[tuple[int, int]], expected: list[int]) -> None:
    config = make_config("standard", {"iterations": 3_000, "low_resolution_until": 12_000})
    cameras = [_camera(*size) for size in sizes]
    assert [downscale_factor(config, cameras, iteration) for iteration in (0, 1, 601, 1_200, 1_201, 3_000)] == expected


@pytest.mark.parametrize("options", [{"low_resolution_until": 0}, {"low_resolution_until": 1, "iterations": 1}])
def test_without_the_option_no_image_is_downscaled(options: dict[str, int]) -> None:
    config = make_config("standard", options)
    assert [downscale_factor(config, [_camera(800, 800)], iteration) for iteration in (0, 1)] == [1, 1]


def test_a_downscaled_camera_has_the_same_field_of_view() -> None:
    camera = _camera(401, 301)
    small = downscaled(camera, 2)
    assert (small.width, small.height) == (201, 151)
    for large, less, side, half in ((camera.fx, small.fx, 401, 201), (camera.cy, small.cy, 301, 151)):
        assert less / half == pytest.approx(large / side, rel=1e-15)
    assert downscaled(camera, 1) is camera


@pytest.fixture
def begins_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """The images of the micro capture are small already: let them be downscaled further."""
    monkeypatch.setattr(resolution, "MIN_SIDE", 4)


def _trainer(micro: Path, **options: object) -> Trainer:
    return micro_trainer(micro, **({"iterations": 40, "low_resolution_until": 15_000} | options))


@pytest.mark.usefixtures("begins_small")
def test_steps_use_downscaled_images_first_and_full_ones_later(micro: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = _trainer(micro)
    side = trainer.capture.train[0].camera.width
    drawn: list[tuple[int, int]] = []
    rgb = trainer.images.rgb

    def noted(frame):  # type: ignore[no-untyped-def]
        drawn.append((frame.camera.width, rgb(frame).shape[1]))
        return rgb(frame)

    monkeypatch.setattr(trainer.images, "rgb", noted)
    reports = steps(trainer, 40)
    times = trainer.pyramid.at(1).factor
    assert times > 1
    assert drawn[0] == (-(-side // times),) * 2
    assert drawn[19][0] < side
    assert drawn[20:] == [(side, side)] * 20
    assert len(events_of(reports, "low_resolution")) == 1


@pytest.mark.usefixtures("begins_small")
def test_a_downscaled_image_is_an_area_average(micro: Path) -> None:
    trainer = _trainer(micro)
    level = trainer.pyramid.at(20)
    whole, small = trainer.images.rgb(trainer.capture.train[0]), trainer.images.rgb(level.frames[0])
    assert level.factor == 2
    np.testing.assert_allclose(small, shrink(whole, small.shape[1], small.shape[0]), atol=2 / 65535)


@pytest.mark.usefixtures("begins_small")
def test_the_low_pass_follows_the_resolution_of_the_step(micro: Path, tmp_path: Path) -> None:
    run = TrainingRun.create(micro, tmp_path / "run", micro_config(iterations=40, low_resolution_until=15_000))
    references = {}
    for report in run:
        references[report.iteration] = run._trainer.scene.sampling.reference
        if report.iteration == 20:
            run.save()
            model = open_model(tmp_path / "run")
            assert model.iteration == 20
            assert model.scene.sampling == run._trainer.scene.sampling  # who looks meanwhile sees what training saw
    assert references[20] == pytest.approx(references[21] / 2)
    assert open_model(tmp_path / "run").scene.sampling.reference == references[21] == references[40]


@pytest.mark.usefixtures("begins_small")
@pytest.mark.parametrize("stop", [9, 20, 21])
def test_an_interrupted_training_equals_the_unbroken_one(micro: Path, stop: int) -> None:
    whole, first, second = (_trainer(micro) for _ in range(3))
    steps(whole, 30)
    steps(first, stop)
    second.load(copy.deepcopy(first.scene), *first.state())
    steps(second, 30 - stop)
    pairs = zip(whole.scene.parameters(), second.scene.parameters(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)
    assert second.scene.sampling == whole.scene.sampling


@pytest.mark.usefixtures("begins_small")
def test_the_loss_trend_restarts_when_the_resolution_changes(micro: Path) -> None:
    trainer = _trainer(micro)
    steps(trainer, 20)
    trainer.guard.trend.best = 1e-9  # whatever comes is far above it
    steps(trainer, 1)
    assert trainer.guard.trend.best == trainer.guard.trend.mean


@pytest.mark.usefixtures("begins_small")
def test_a_rollback_to_a_lower_resolution_restores_neither_its_losses_nor_its_low_pass(micro: Path) -> None:
    trainer = _trainer(micro, **{"guard.snapshot_every": 15})
    steps(trainer, 22)
    assert trainer.snapshots.newest.scene.sampling == trainer.pyramid.at(15).sampling
    with torch.no_grad():
        next(trainer.scene.parameters()).view(-1)[0] = float("nan")
    (event,) = trainer.check()
    assert isinstance(event, RolledBack)
    assert event.to_iteration == 15
    assert trainer.scene.sampling == trainer.pyramid.at(22).sampling != trainer.pyramid.at(15).sampling
    assert trainer.guard.trend.mean is None
