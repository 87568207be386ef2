"""Several views a step: every view once in a pass, the step of their mean loss, and the same after an interruption."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from graings.capture.capture import Frame
from graings.raster.photometric import photometric
from graings.render import draw
from graings.training.trainer import Trainer
from tests.training.micro import finite, micro_trainer, quality, steps


def watched(trainer: Trainer, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Names of the frames of every step from now on."""
    taken: list[list[str]] = []
    choose = trainer.views.next

    def noted(iteration: int) -> list[Frame]:
        frames = choose(iteration)
        taken.append([frame.name for frame in frames])
        return frames

    monkeypatch.setattr(trainer.views, "next", noted)
    return taken


@pytest.mark.parametrize("batch", [1, 2, 4, 50])
def test_a_pass_uses_every_view_once_and_no_step_spans_two_passes(
    micro: Path, monkeypatch: pytest.MonkeyPatch, batch: int
) -> None:
    trainer = micro_trainer(micro, batch=batch, time_window=1)
    names = {frame.name for frame in trainer.capture.train}
    taken = watched(trainer, monkeypatch)
    for _ in range(3):
        taken.clear()
        while not taken or trainer.views.upcoming(trainer.iteration):
            trainer.step()
        assert sorted(name for step in taken for name in step) == sorted(names)
        assert len(taken) == -(-len(names) // batch)
        sizes = [len(step) for step in taken]
        assert max(sizes) - min(sizes) <= 1


def test_learning_rates_depend_on_the_views_per_step(micro: Path) -> None:
    few, some = micro_trainer(micro, batch=50), micro_trainer(micro, batch=2)
    views = len(few.capture.train)
    ratio = few.optimizer.rate("offsets", 1) / some.optimizer.rate("offsets", 1)
    assert ratio == pytest.approx((views / 2) ** (1 / 3))


def test_a_step_descends_the_mean_loss_of_its_views(micro: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without = {f"loss.{name}": 0 for name in ("temporal", "deformation", "residual", "rigidity")}
    trainer = micro_trainer(micro, batch=3, warmup=0, network_precision="float32", **without)
    steps(trainer, 5)
    before, chosen, stepped = copy.deepcopy(trainer.scene), [], {}
    choose = trainer.views.next
    monkeypatch.setattr(trainer.views, "next", lambda step: chosen.extend(choose(step)) or list(chosen))
    parameters = dict(trainer.scene.named_parameters())

    def noted(iteration: int) -> None:
        stepped.update({name: p.grad.clone() for name, p in parameters.items() if p.grad is not None})

    monkeypatch.setattr(trainer.optimizer, "step", noted)
    report = trainer.step()
    losses: list[Tensor] = []
    for frame in chosen:
        drawn = draw(before.compose(frame.camera.center, frame.time), frame.camera, trainer.background)
        target, weights = torch.from_numpy(trainer.images.rgb(frame)), trainer.config.loss
        alpha = trainer.images.alpha(frame)
        assert alpha is not None
        opaque = functional.smooth_l1_loss(drawn.alpha, torch.from_numpy(alpha), beta=1 / 255)
        losses.append(photometric(drawn.color, target, weights.ssim, weights.squared) + weights.alpha * opaque)
    assert len(losses) > 1
    mean = torch.stack(losses).mean()
    mean.backward()
    assert report.loss == pytest.approx(float(mean.detach()), rel=1e-6)
    for name, parameter in before.named_parameters():
        if parameter.grad is not None:
            difference = (parameter.grad - stepped[name]).norm()
            # Sums of a few thousand float32 terms in two orders.
            assert float(difference) <= 1e-4 * float(parameter.grad.norm()), name


def test_an_interrupted_training_equals_the_unbroken_one(micro: Path) -> None:
    options = {"iterations": 40, "batch": 4}
    whole, first, second = (micro_trainer(micro, **options) for _ in range(3))
    steps(whole, 20)
    steps(first, 9)
    second.load(copy.deepcopy(first.scene), *first.state())
    steps(second, 11)
    pairs = zip(whole.scene.parameters(), second.scene.parameters(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)


def test_training_with_several_views_per_step_improves_quality(micro: Path) -> None:
    trainer = micro_trainer(micro, iterations=60, batch=3)
    before = quality(trainer)
    steps(trainer, 60)
    assert finite(trainer)
    assert quality(trainer) > before + 3
