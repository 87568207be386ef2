"""What the guard lets through, limits, skips and gives up on (STAB-10), on numbers alone."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from graings.config import GuardConfig
from graings.training.guard.guard import MAX_RECENT_SKIPS, MEMORY, MIN_NORMS, WINDOW, Gradient, Guard, first_not_finite
from graings.training.guard.loss_trend import GROWTH_PAUSE, LossTrend

ONE, NAN = torch.tensor(1.0), torch.tensor(float("nan"))


def _gradient(values: Tensor, group: str = "g") -> list[Gradient]:
    return [Gradient("p", group, values)]


def _settled() -> Guard:
    """A guard that has seen enough gradients of norm 1."""
    guard = Guard(GuardConfig())
    for iteration in range(WINDOW):
        assert not guard.check_step(iteration, ONE, _gradient(torch.tensor([0.6, 0.8]))).limits
    return guard


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_one_bad_entry_of_a_gradient_is_named(bad: float) -> None:
    guard, values = Guard(GuardConfig()), torch.ones(100)
    assert guard.check_step(1, ONE, _gradient(values)).non_finite is None
    values[37] = bad
    assert guard.check_step(2, ONE, _gradient(values)).non_finite == "the gradient of p"
    assert guard.check_step(3, torch.tensor(bad), []).non_finite == "the loss"
    assert guard.skipped == 2


def test_a_gradient_whose_square_overflows_counts_as_large_not_as_infinite() -> None:
    assert Guard(GuardConfig()).check_step(1, ONE, _gradient(torch.full((100,), 1e30))).non_finite is None


def test_a_group_far_above_its_median_norm_is_clipped_and_the_others_are_not() -> None:
    guard = _settled()
    usual = Gradient("q", "h", torch.ones(1))
    verdict = guard.check_step(WINDOW, ONE, [*_gradient(torch.tensor([300.0, 400.0])), usual])
    assert verdict.limits == {"g": (pytest.approx(500.0), pytest.approx(100.0))}
    assert guard.clipped == 1
    assert not guard.check_step(WINDOW + 1, ONE, _gradient(torch.tensor([60.0, 79.0]))).limits


def test_nothing_is_clipped_before_the_usual_norm_is_known() -> None:
    guard = Guard(GuardConfig())
    for iteration in range(MIN_NORMS):
        assert not guard.check_step(iteration, ONE, _gradient(torch.tensor([10.0**iteration]))).limits


def test_a_permanent_change_of_the_norm_becomes_the_usual_norm() -> None:
    guard = _settled()
    limited = [bool(guard.check_step(i, ONE, _gradient(torch.tensor([1e3]))).limits) for i in range(2 * WINDOW)]
    assert limited[0]
    assert not limited[-1]


def test_three_skipped_steps_in_a_row_are_a_problem_and_a_good_one_resets_the_count() -> None:
    guard = Guard(GuardConfig())
    for iteration, loss in enumerate((NAN, NAN, ONE, NAN, NAN)):
        guard.check_step(iteration, loss, [])
        assert guard.problem() is None
    guard.check_step(5, NAN, [])
    assert guard.problem() == "the loss was not finite in 3 steps in a row"


def test_ten_skipped_steps_among_a_thousand_are_a_problem_and_older_ones_do_not_count() -> None:
    often, rarely = Guard(GuardConfig()), Guard(GuardConfig())
    for number in range(MAX_RECENT_SKIPS):
        for guard, apart in ((often, 50), (rarely, MEMORY // MAX_RECENT_SKIPS + 12)):
            assert guard.problem() is None
            guard.check_step(number * apart, NAN, [])
            guard.check_step(number * apart + 1, ONE, [])
    assert "10 of the last 1000 steps" in str(often.problem())
    assert rarely.problem() is None


def test_a_guard_continues_from_its_state_with_the_same_results() -> None:
    one = _settled()
    one.check_step(WINDOW, NAN, [])
    other = Guard(GuardConfig())
    other.load(*one.state())
    assert other.state()[1] == one.state()[1]
    large = _gradient(torch.tensor([1e4]))
    assert other.check_step(WINDOW + 1, ONE, large) == one.check_step(WINDOW + 1, ONE, large)


def test_a_rollback_keeps_the_counts_and_clears_the_problem() -> None:
    before = Guard(GuardConfig())
    for iteration in range(3):
        before.check_step(iteration, NAN, [])
    after = Guard(GuardConfig())
    after.rolled_back(before)
    assert (after.skipped, after.problem()) == (3, None)


def test_the_first_tensor_that_is_not_finite_is_named() -> None:
    tensors = {"a": torch.ones(3), "b": torch.tensor([1.0, float("inf")]), "c": torch.tensor(float("nan"))}
    assert first_not_finite(tensors) == "b"
    assert first_not_finite({"a": torch.full((3,), 1e38)}) is None
    assert first_not_finite({}) is None


def _losses(trend: LossTrend, *losses: tuple[float, int]) -> None:
    for loss, times in losses:
        for _ in range(times):
            trend.add(loss)


def test_a_loss_that_stays_far_above_its_best_is_divergence() -> None:
    trend = LossTrend(GuardConfig(patience=200))
    _losses(trend, (0.1, 300), (0.5, 150))
    assert trend.problem() is None
    assert not trend.healthy
    _losses(trend, (0.5, 100))
    assert "after it had been 0.1" in str(trend.problem())


@pytest.mark.parametrize(("best", "later"), [(0.001, 0.015), (0.1, 0.19)])
def test_a_small_loss_that_doubles_is_no_divergence(best: float, later: float) -> None:
    trend = LossTrend(GuardConfig(patience=10))
    _losses(trend, (best, 300), (later, 1000))
    assert trend.problem() is None
    assert trend.healthy


def test_a_single_outlier_is_no_divergence() -> None:
    trend = LossTrend(GuardConfig(patience=100))
    _losses(trend, (0.1, 300), (5.0, 1), (0.1, 300))
    assert trend.problem() is None


def test_an_easy_first_view_does_not_set_the_best_loss() -> None:
    trend = LossTrend(GuardConfig(patience=10))
    _losses(trend, (0.01, 1), (0.3, 300))
    assert trend.problem() is None


def test_steps_right_after_a_growth_do_not_count_as_divergence() -> None:
    trend = LossTrend(GuardConfig(patience=10))
    _losses(trend, (0.1, 300))
    trend.grown()
    _losses(trend, (5.0, GROWTH_PAUSE))
    assert trend.problem() is None
    _losses(trend, (5.0, 10))
    assert trend.problem() is not None


def test_a_loss_trend_continues_from_its_state() -> None:
    one, other = LossTrend(GuardConfig()), LossTrend(GuardConfig())
    _losses(one, (0.1, 50), (0.7, 20))
    other.load(one.state())
    assert other.state() == one.state()
    assert math.isfinite(one.state()["mean"])
