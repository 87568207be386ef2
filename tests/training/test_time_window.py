"""A training that begins with the middle of the clip."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch

from graings.config import make_config
from graings.training.curriculum.time_window import TimeWindow
from tests.training.micro import micro_trainer, steps

TIMES = [index / 20 for index in range(21)]


def test_the_window_widens_from_the_middle_to_the_whole_clip() -> None:
    window = TimeWindow(make_config("long", {"time_window_until": 11_000, "warmup": 1_000}), TIMES, 0.2)

    def taking_part(iteration: int) -> list[float]:
        return [time for view, time in enumerate(TIMES) if window.has(view, iteration)]

    assert taking_part(0) == taking_part(1_000) == [0.4, 0.45, 0.5, 0.55, 0.6]
    assert window.share(6_000) == pytest.approx(0.6)
    assert taking_part(10_999) == TIMES[1:-1]
    assert taking_part(11_000) == taking_part(30_000) == TIMES


def test_a_window_narrower_than_the_frame_interval_keeps_the_middle_view() -> None:
    window = TimeWindow(make_config("long"), [0.0, 0.4, 1.0], 1e-6)
    assert [window.has(view, 0) for view in range(3)] == [False, True, False]


def test_losses_are_compared_within_a_stage_of_the_window_only(micro: Path) -> None:
    trainer = micro_trainer(micro, iterations=600, time_window=0.3, **{"guard.patience": 20})
    steps(trainer, 60)
    worse = 0
    for _ in range(300):
        before = trainer.window.stage(trainer.iteration)
        trainer.guard.trend.add(10.0)  # what a view of a new time would do
        trainer.step()
        changed = trainer.window.stage(trainer.iteration) != before
        worse += not changed
        assert not changed or trainer.guard.trend.above == 0
        assert not changed or trainer.guard.trend.mean < 1.0
    assert 200 < worse < 300
    assert trainer.window.stage(trainer.iteration) == 20


def test_a_rollback_to_another_stage_compares_no_losses_with_it(micro: Path) -> None:
    trainer = micro_trainer(micro, iterations=600, time_window=0.3)
    steps(trainer, 20)
    assert trainer.guard.trend.mean is not None
    trainer._take_snapshot()
    trainer.iteration = 590
    trainer._roll_back("a test")
    assert trainer.guard.trend.mean is None


def test_views_outside_the_window_are_not_used_until_it_is_wide(micro: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = micro_trainer(micro, iterations=60, time_window=0.3)
    drawn: list[float] = []
    rgb = trainer.images.rgb

    def noted(frame):  # type: ignore[no-untyped-def]
        drawn.append(frame.time)
        return rgb(frame)

    monkeypatch.setattr(trainer.images, "rgb", noted)
    steps(trainer, 60)
    assert all(abs(time - 0.5) <= 0.15 for time in drawn[:6])  # the warm-up
    assert {0.0, 1.0} <= set(drawn[30:])


def test_a_pass_ends_with_the_last_view_inside_the_window(micro: Path) -> None:
    trainer = micro_trainer(micro, iterations=600, time_window=0.3)
    within = sum(trainer.window.has(view, 1) for view in range(len(trainer.capture.train)))
    assert 1 < within < len(trainer.capture.train)
    ends = []
    for _ in range(3 * within):
        trainer.step()
        ends.append(not trainer.views.upcoming(trainer.iteration))
    assert ends == ([False] * (within - 1) + [True]) * 3


def test_an_interrupted_training_equals_the_unbroken_one(micro: Path) -> None:
    options = {"iterations": 40, "time_window": 0.3}
    whole, first, second = (micro_trainer(micro, **options) for _ in range(3))
    steps(whole, 20)
    steps(first, 9)
    second.load(copy.deepcopy(first.scene), *first.state())
    steps(second, 11)
    pairs = zip(whole.scene.parameters(), second.scene.parameters(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)
