"""Steps beside the sizes of what they move, and what is smaller than a pixel."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from graings.camera import Camera
from graings.capture.capture import Frame
from graings.raster.rasterize import rasterize
from graings.training.run import TrainingRun
from graings.training.stiffness import Stiffness, footprints, step_over_size, subpixel_share
from tests.capture.captures import orbit
from tests.models import tiny_scene
from tests.scenes import gaussians, pinhole, rows
from tests.training.micro import finite, micro_config, micro_trainer, steps

WHITE = (1.0, 1.0, 1.0)


def test_a_step_is_measured_by_the_thinnest_axis_of_what_is_there_both_times() -> None:
    before = gaussians(1_000, seed=0)
    thinnest = before.log_scales.amin(1).exp()
    share = torch.linspace(0, 1, 1_000, dtype=torch.float64)  # how far each goes, in its own thinnest axes
    shifted = before.means + torch.nn.functional.normalize(torch.randn(1_000, 3, dtype=torch.float64)) * (
        thinnest * share
    ).unsqueeze(1)
    after = replace(before, means=shifted)
    assert step_over_size(before, after) == pytest.approx(0.99, abs=1e-3)
    # Others come and go, and rows change places: each is still compared with itself.
    order = torch.randperm(900, generator=torch.Generator().manual_seed(1)) + 100
    assert step_over_size(rows(before, torch.arange(950)), rows(after, order)) == pytest.approx(0.99 * 0.95, abs=0.02)
    assert step_over_size(rows(before, torch.arange(10)), rows(after, torch.arange(10, 20))) is None


def test_a_footprint_is_the_projected_size_without_its_low_pass() -> None:
    """On the optical axis a ball of radius s at depth Z is f s / Z px on each axis; a needle along x only on one."""
    sizes = torch.logspace(-4, -1, 13, dtype=torch.float64)
    many = gaussians(13, seed=0)
    balls = replace(
        many,
        means=torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64).expand(13, 3).contiguous(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(13, 4).contiguous(),
        log_scales=sizes.log().unsqueeze(1).expand(13, 3).contiguous(),
        opacities=torch.full((13,), 0.5, dtype=torch.float64),
    )
    camera = pinhole(focal=40.0)
    ground = torch.ones(3, dtype=torch.float64)
    expected = 40.0 * sizes / 2.0
    size = footprints(balls, rasterize(balls, camera, ground).radii)
    torch.testing.assert_close(size, math.sqrt(2) * expected, rtol=1e-3, atol=0)
    scales = balls.log_scales.clone()
    scales[:, 1:] = -20
    needles = replace(balls, log_scales=scales)
    torch.testing.assert_close(
        footprints(needles, rasterize(needles, camera, ground).radii), expected, rtol=1e-3, atol=0
    )


def _frame(focal: float) -> Frame:
    camera = orbit(0, 1, (32, 32))
    seen = Camera(camera.world_to_camera, focal, focal, 16, 16, 32, 32)
    return Frame("view", seen, 0.5, Path("view.png"), (32, 32))


def test_what_one_view_resolves_is_not_below_the_pixel() -> None:
    scene = tiny_scene(anchors=40)
    far, middle, near = _frame(0.1), _frame(8.0), _frame(60.0)
    shares = [subpixel_share(scene, [frame], WHITE) for frame in (far, middle, near)]
    assert shares[0] == 1.0
    assert shares[2] == 0.0
    assert 0 < shares[1] < 1  # type: ignore[operator]
    assert subpixel_share(scene, [far, near], WHITE) == 0.0
    assert subpixel_share(scene, [], WHITE) is None


def test_a_ratio_of_a_million_in_one_scene_trains_and_is_reported(micro: Path) -> None:
    """D11: detail of a millionth of the room, inside it."""
    trainer = micro_trainer(micro)
    scaffold = trainer.scene.scaffold
    with torch.no_grad():
        small = torch.arange(scaffold.count) % 2 == 0
        scaffold.log_scales[small] -= math.log(1e6)
    assert subpixel_share(trainer.scene, trainer.capture.train, WHITE) > 0.2  # type: ignore[operator]
    steps(trainer, 100)
    assert finite(trainer)
    assert trainer.guard.rollbacks == 0
    assert trainer.step_over_size is not None
    assert trainer.step_over_size > 1  # a step that suits the room throws the detail about


def test_a_run_says_how_stiff_it_was(micro: Path, tmp_path: Path) -> None:
    """In every point of its curve and at its end, where rates that never fall leave it stiff and small ones do not."""
    for name, rate, stiff in (("calm", 1e-5, False), ("wild", 2.0, True)):
        config = micro_config(iterations=100, **{"rates.offsets": (rate, rate), "rates.log_scales": (1e-5, 1e-5)})
        reports = list(TrainingRun.create(micro, tmp_path / name, config))
        document = json.loads((tmp_path / name / "metrics.json").read_text())
        assert document["stiffness"]["stiff"] is stiff, document["stiffness"]
        assert document["stiffness"]["views"] == 6
        assert 0 <= document["stiffness"]["subpixel_share"] <= 1
        assert document["curve"][-1]["step_over_size"] == document["stiffness"]["step_over_size"]
        told = any(event.startswith("stiff: ") for event in reports[-1].events)
        assert told is stiff
        assert any(event["what"].startswith("stiff: ") for event in document["events"]) is stiff


def test_nothing_measured_is_not_stiff() -> None:
    assert not Stiffness(None, None, 0).stiff
