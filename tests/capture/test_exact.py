"""The arithmetic of the synthetic suite: close to the C library, independent of it."""

from __future__ import annotations

import math

import numpy as np

from graings.capture.synthetic.exact import cosine, sine, smooth, uniform


def test_sine_and_cosine_agree_with_the_library() -> None:
    turns = np.linspace(-3.0, 3.0, 2001)
    np.testing.assert_allclose(sine(turns), np.sin(2 * np.pi * turns), atol=1e-11)
    np.testing.assert_allclose(cosine(turns), np.cos(2 * np.pi * turns), atol=1e-11)


def test_a_float_and_an_array_have_the_same_sine() -> None:
    turns = np.linspace(-2.0, 2.0, 101)
    assert [sine(value) for value in turns.tolist()] == sine(turns).tolist()
    assert isinstance(sine(0.3), float)
    assert math.isclose(sine(0.25), 1.0, abs_tol=1e-11)


def test_random_numbers_depend_on_seed_and_name_only() -> None:
    numbers = uniform(0, "cameras", 1000)
    assert (numbers >= 0).all()
    assert (numbers < 1).all()
    assert abs(numbers.mean() - 0.5) < 0.05
    assert uniform(0, "cameras", 3).tolist() == numbers[:3].tolist()
    assert uniform(1, "cameras", 3).tolist() != numbers[:3].tolist()
    assert uniform(0, "other", 3).tolist() != numbers[:3].tolist()


def test_the_smooth_step_is_flat_at_both_ends() -> None:
    assert smooth(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])).tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
    assert smooth(0.5) == 0.5
