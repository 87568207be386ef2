"""Every instruction set this CPU can run, one after the other."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from graings.raster import kernel


@pytest.fixture(params=kernel.available_isas())
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    before = kernel.active_isa()
    kernel.use_isa(request.param)
    yield request.param
    kernel.use_isa(before)
