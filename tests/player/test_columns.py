"""Tables: every value comes back within half a step, whatever its size and however they are stored."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from graings.player.columns import MAX_PLANES, pack, unpack

TABLES = arrays(
    np.float32,
    st.tuples(st.integers(0, 9), st.integers(0, 5)),
    elements=st.floats(-1e4, 1e4, width=32),
)


@settings(deadline=None)
@given(values=TABLES, step=st.floats(1e-6, 10.0), delta=st.booleans())
def test_values_come_back_within_half_a_step(values: np.ndarray, step: float, delta: bool) -> None:
    table, data = pack("some", values, step, 3, delta=delta)
    assert len(data) == table.bytes
    found = unpack(table, b"abc" + data)
    assert (found.shape, found.dtype) == (values.shape, np.float32)
    # Beside half a step the rounding of offsets and results to float32.
    allowed = 0.51 * np.array(table.steps) + 4e-7 * (np.abs(values) + np.abs(np.array(table.offsets)))
    assert (np.abs(found - values) <= allowed).all()


def test_each_column_has_its_own_step() -> None:
    values = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    table, data = pack("some", values, [0.5, 0.001], 0)
    errors = np.abs(unpack(table, data) - values).max(0)
    assert errors[0] > 0.1
    assert errors[1] <= 0.00051


def test_few_steps_take_one_byte_and_many_at_most_three() -> None:
    values = np.linspace(0, 1, 100, dtype=np.float32)[:, None]
    assert [pack("some", values, step, 0)[0].planes for step in (1 / 200, 1 / 60000, 1e-12)] == [1, 2, MAX_PLANES]


@pytest.mark.parametrize("delta", [False, True])
def test_the_layout_is_the_documented_one(delta: bool) -> None:
    """docs/player.md: planes of bytes, lowest first, each column by column; differences fold their sign."""
    values = np.array([[0, 5], [300, 4], [299, 6]], dtype=np.float32)
    table, data = pack("some", values, 1.0, 0, delta=delta)
    first, second = [0, 300, 299], [1, 0, 2]
    if delta:
        first, second = [0, 600, 1], [2, 1, 4]
    low = bytes(number & 255 for number in first + second)
    high = bytes(number >> 8 for number in first + second)
    assert (table.offsets, table.planes, data) == ((0.0, 4.0), 2, low + high)
