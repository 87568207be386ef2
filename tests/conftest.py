"""While tests run, shapes are checked: the jaxtyping annotations of the method are enforced by beartype.

Modules that meet callers (readers, rasterizer, metrics) check their arguments themselves and are tested for the
errors they give, which the hook would forestall.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from jaxtyping import install_import_hook

from graings import kernel
from tests import shapes

install_import_hook(["graings.scene", "graings.training", "graings.render"], f"{shapes.__name__}.checked")


def pytest_runtest_setup() -> None:
    """Every test begins with all shape checks and one thread: two processes run tests beside each other."""
    shapes.begin_test()
    kernel.use_threads(1)


@pytest.fixture(params=kernel.available_isas())
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Every instruction set this CPU can run, one after the other."""
    before = kernel.active_isa()
    kernel.use_isa(request.param)
    yield request.param
    kernel.use_isa(before)
