"""Squared differences join the photometric loss once nothing grows any more."""

from __future__ import annotations

from pathlib import Path

import torch

from tests.training.micro import GROWING, micro_trainer, steps


def test_the_squared_error_starts_after_the_last_growth(micro: Path) -> None:
    without, weighed = (micro_trainer(micro, **GROWING, **{"loss.squared": weight}) for weight in (0.0, 10.0))
    last = weighed.config.scaled(weighed.config.density.grow_until)
    assert 0 < last < weighed.config.iterations
    for trainer in (without, weighed):
        steps(trainer, last)
    pairs = [list(one.scene.parameters()) for one in (without, weighed)]
    assert all(torch.equal(a, b) for a, b in zip(*pairs, strict=True))
    first, second = (steps(trainer, 1)[0] for trainer in (without, weighed))
    mean_square = 10.0 ** (-first.psnr / 10.0)  # of the one view of a step
    assert abs(second.loss - first.loss - 10.0 * mean_square) < 1e-6
    pairs = [list(one.scene.parameters()) for one in (without, weighed)]
    assert not all(torch.equal(a, b) for a, b in zip(*pairs, strict=True))


def test_a_large_weight_of_the_squared_error_is_no_divergence(micro: Path) -> None:
    """The guard compares losses of before and after: what has joined is not what went wrong."""
    trainer = micro_trainer(micro, **GROWING, **{"loss.squared": 1_000.0, "guard.patience": 5})
    last = trainer.config.scaled(trainer.config.density.grow_until)
    before = steps(trainer, last)[-1]
    after = steps(trainer, 30)
    assert after[0].loss > 3 * before.loss
    assert trainer.guard.rollbacks == 0
    assert trainer.guard.trend.healthy
