"""Steps beside the sizes of what they move, and what is smaller than a pixel."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from graings.camera.camera import Camera
from graings.capture.capture import Frame
from graings.constants import BLUR
from graings.gaussians import Gaussians
from graings.raster.rasterize import rasterize
from graings.raster.reference import _rotations
from graings.training.guard.stiffness import STIFF, Stiffness, footprints, step_over_size, subpixel_share
from graings.training.run import TrainingRun
from tests.capture.captures import orbit
from tests.models import tiny_scene
from tests.scenes import gaussians, pinhole, rows
from tests.training.micro import events_of, finite, micro_config, micro_trainer, steps

WHITE = (1.0, 1.0, 1.0)


def _predicted_deformation(batch: Gaussians, share: Tensor) -> Gaussians:
    """Each Gaussian goes `share` of its own size, in a direction of its own, by the oracle's rotations."""
    direction = torch.randn(len(batch), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    local = direction / direction.norm(dim=1, keepdim=True) * batch.log_scales.exp() * share.unsqueeze(1)
    return replace(batch, means=batch.means + (_rotations(batch.quats) @ local.unsqueeze(2)).squeeze(2))


def test_a_step_is_measured_in_sizes_of_what_is_there_both_times() -> None:
    sharp = pinhole(focal=1e12)  # sees everything: no pixel widens a Gaussian
    before = gaussians(1_000, seed=0)
    after = _predicted_deformation(before, torch.linspace(0, 1, 1_000, dtype=torch.float64))
    assert step_over_size(before, after, sharp, BLUR) == pytest.approx(0.99, abs=1e-6)
    # Others come and go, and rows change places: each is still compared with itself.
    order = torch.randperm(900, generator=torch.Generator().manual_seed(1)) + 100
    common = step_over_size(rows(before, torch.arange(950)), rows(after, order), sharp, BLUR)
    assert common == pytest.approx((100 + 0.99 * 849) / 999, abs=1e-6)
    assert step_over_size(rows(before, torch.arange(10)), rows(after, torch.arange(10, 20)), sharp, BLUR) is None


def test_what_is_lost_has_no_length() -> None:
    before = gaussians(10, seed=0)
    for lost in (math.nan, math.inf):
        means = before.means.clone()
        means[3, 1] = lost
        assert step_over_size(before, replace(before, means=means), pinhole(), BLUR) is None


def test_a_step_that_was_undone_is_not_told_of(micro: Path) -> None:
    """Metrics hold finite numbers only: a lost scene is measured, found, and forgotten with the step."""
    trainer = micro_trainer(micro, **{"guard.check_every": 5})
    steps(trainer, 34)
    good = trainer.snapshots.newest.facts["step_over_size"]
    assert trainer.step_over_size != good
    with torch.no_grad():
        trainer.scene.scaffold.offsets[0] = math.inf
    report = trainer.step()
    assert events_of([report], "rolled_back")
    assert trainer.step_over_size == good


def test_a_run_that_goes_on_knows_how_long_its_last_steps_were(micro: Path) -> None:
    """A point of the curve soon after a checkpoint says so too, measured or not since."""
    first = micro_trainer(micro, **{"guard.check_every": 5})
    steps(first, 7)
    assert first.step_over_size is not None
    second = micro_trainer(micro)
    second.load(copy.deepcopy(first.scene), *first.state())
    assert second.step_over_size == first.step_over_size


def test_what_is_thinner_than_a_pixel_is_as_wide_as_the_low_pass() -> None:
    """A disc far thinner than a pixel, moved by a pixel: one over the root of the blur's variance."""
    camera = pinhole(focal=40.0)
    disc = replace(
        gaussians(1, seed=0),
        means=torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64),
        log_scales=torch.tensor([[-25.0, -25.0, -25.0]], dtype=torch.float64),
    )
    pixel = torch.tensor([[2.0 / 40.0, 0.0, 0.0]], dtype=torch.float64)
    assert step_over_size(disc, replace(disc, means=disc.means + pixel), camera, BLUR) == pytest.approx(
        1 / math.sqrt(BLUR), rel=1e-3
    )


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
    size = footprints(balls, rasterize(balls, camera, ground).radii, BLUR)
    torch.testing.assert_close(size, math.sqrt(2) * expected, rtol=1e-3, atol=0)
    scales = balls.log_scales.clone()
    scales[:, 1:] = -20
    needles = replace(balls, log_scales=scales)
    torch.testing.assert_close(
        footprints(needles, rasterize(needles, camera, ground).radii, BLUR), expected, rtol=1e-3, atol=0
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
    assert math.isfinite(trainer.step_over_size)


def test_a_run_says_how_stiff_it_was(micro: Path, tmp_path: Path) -> None:
    """In every point of its curve and at its end; where steps are long, it depends on the last bit how long."""
    found = {}
    for name, rate in (("calm", 1e-5), ("wild", 2.0)):
        config = micro_config(iterations=100, **{"rates.offsets": (rate, rate), "rates.log_scales": (1e-5, 1e-5)})
        reports = list(TrainingRun.create(micro, tmp_path / name, config))
        document = json.loads((tmp_path / name / "metrics.json").read_text())
        facts = document["stiffness"]
        found[name] = facts["step_over_size"]
        assert facts["stiff"] is (found[name] > STIFF)
        assert facts["views"] == 6
        assert 0 <= facts["subpixel_share"] <= 1
        assert document["curve"][-1]["step_over_size"] == found[name]
        assert bool(events_of(reports[-1:], "stiff")) is facts["stiff"]
        assert any(event["kind"] == "stiff" for event in document["events"]) is facts["stiff"]
    assert found["calm"] < 0.1
    assert found["wild"] > 10 * found["calm"]


def test_what_is_longer_than_itself_is_stiff_and_told_with_its_remedy() -> None:
    (event,) = Stiffness(1.5, 0.0, 6).events(100)
    assert (event.iteration, event.step_over_size) == (100, 1.5)
    assert event.message == (
        "the last steps still move Gaussians by 1.5 times their own size (99th percentile). "
        "Train longer, or with lower final `rates` of offsets, deformation and matrices."
    )
    for calm in (Stiffness(1.0, 0.0, 6), Stiffness(None, None, 0)):
        assert not calm.stiff
        assert calm.events(100) == ()
