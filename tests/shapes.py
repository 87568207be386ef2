"""The type checker behind the shape annotations: beartype, which cannot check numpy's ArrayLike.

A check costs as much as a small operator, and half the time of a training of a few anchors. A test checks its first
calls, more than a dozen training steps; what a longer training computes afterwards has passed through the same code.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from beartype import BeartypeConf, FrozenDict, beartype
from jaxtyping import config
from numpy.typing import ArrayLike

CALLS_CHECKED_PER_TEST = 4_000

_beartype = beartype(conf=BeartypeConf(hint_overrides=FrozenDict({ArrayLike: object})))
_calls = 0


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` with its annotations enforced, until the running test has had its share of checks."""
    enforced = _beartype(function)

    @wraps(enforced)
    def counted(*arguments: Any, **options: Any) -> Any:
        global _calls
        _calls += 1
        if _calls == CALLS_CHECKED_PER_TEST:
            config.update("jaxtyping_disable", True)
        return enforced(*arguments, **options)

    return counted


def begin_test() -> None:
    """Check again from here on."""
    global _calls
    _calls = 0
    config.update("jaxtyping_disable", False)
