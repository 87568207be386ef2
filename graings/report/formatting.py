"""Numbers as a reader wants to see them."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """Seconds for a reader."""
    for length, unit in ((3600, "h"), (60, "min")):
        if seconds >= length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.3g} s"


def error(value: float) -> str:
    """A root mean squared error for a reader."""
    return f"{value:.3f}" if value >= 0.01 else f"{value:.2g}"


def count(number: float) -> str:
    """A number of things for a reader."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.3g}{unit}"
    return f"{number:.3g}"
