"""Numbers as text for people."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """Seconds in the unit that fits: s, min or h."""
    for length, unit in ((3600, "h"), (60, "min")):
        if seconds >= length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.3g} s"


def error(value: float) -> str:
    """A root mean squared error with three decimals, or two digits where it is small."""
    return f"{value:.3f}" if value >= 0.01 else f"{value:.2g}"


def count(number: float) -> str:
    """A count, thousands as k."""
    return f"{number:.3g}" if number < 1000 else f"{number / 1000:.3g}k"
