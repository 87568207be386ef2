"""Drawing: the ink and the axes that every picture of numbers shares, as handwritten SVG.

No dependencies; the colours follow the reader's light or dark theme. Knows nothing of what the numbers mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

from graings.report.formatting import error

LABEL_ROOM: Final = 44.0  # least distance of two labels on a horizontal axis

# Round numbers for the axes, the most welcome first.
COUNTS: Final = (
    *(10.0**k for k in range(8)),
    *(5 * 10.0**k for k in range(8)),
    *(2 * 10.0**k for k in range(8)),
)
SECONDS: Final = (
    *(1, 10, 60, 600, 3600, 36_000, 360_000, 0.1, 0.01, 0.001),
    *(30, 1800, 18_000, 5, 300, 180_000, 0.5, 0.05),
    *(2, 20, 120, 1200, 7200, 72_000, 0.2, 0.02),
)
DECIBELS: Final = (1, 2, 5, 10, 20)  # steps between grid lines

# Colours are spelled out per theme: not every reader of SVG knows custom properties.
LIGHT: Final = """
text { font-family: system-ui, -apple-system, 'Segoe UI', 'Helvetica Neue', 'DejaVu Sans', Arial, sans-serif;
       font-size: 12px; fill: #6a7178; font-variant-numeric: tabular-nums; }
.title { font-size: 17px; font-weight: 600; fill: #20252a; }
.label { fill: #20252a; }
.value { font-size: 13px; font-weight: 600; fill: #0d6b83; }
.paper { fill: #fcfcfb; }
.grid { stroke: #e6e7e5; stroke-width: 1; }
.axis { stroke: #9aa0a6; stroke-width: 1; }
.curve { fill: none; stroke: #0d6b83; stroke-width: 2; stroke-linejoin: round; stroke-linecap: round; }
.point { fill: #fcfcfb; stroke: #0d6b83; stroke-width: 1.5; }
.last { fill: #0d6b83; }
"""

DARK: Final = """\
  text { fill: #9aa2aa; }
  .title, .label { fill: #e8eaec; }
  .value { fill: #62c6da; }
  .paper { fill: #16191c; }
  .grid { stroke: #2a2e33; }
  .axis { stroke: #5b636b; }
  .curve, .point { stroke: #62c6da; }
  .point { fill: #16191c; }
  .last { fill: #62c6da; }
"""


def sheet(light: str = "", dark: str = "") -> str:
    """The style sheet, with a picture's own rules after the common ones of each theme."""
    return f"{LIGHT}{light}@media (prefers-color-scheme: dark) {{\n{DARK}{dark}}}\n"


def svg(width: float, height: float, title: str, body: Sequence[str], style: str | None = None) -> str:
    """A whole picture of `width` x `height` pixels; `title` is what a screen reader says."""
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" '
            f'height="{height:g}" role="img" aria-label="{escape(title)}">',
            f"<style>{sheet() if style is None else style}</style>",
            f'<rect class="paper" width="{width:g}" height="{height:g}" rx="8"/>',
            *body,
            "</svg>\n",
        ]
    )


@dataclass(frozen=True, slots=True)
class LogAxis:
    """A logarithmic axis of `length` pixels from `start` on, with a little air at both ends.

    A negative length runs upwards when the axis is vertical, as the error does.
    """

    low: float
    high: float
    start: float
    length: float
    ends: tuple[float, ...]  # the extreme values themselves

    @staticmethod
    def over(values: Sequence[float], start: float, length: float) -> LogAxis:
        """The axis that holds `values`; those not above zero sit at its start."""
        smallest = min((value for value in values if value > 0), default=1.0)
        largest = max(*values, smallest)
        low, high = math.log(smallest), math.log(largest)
        air = 0.04 * (high - low) if high > low else 1.0
        ends = (smallest, largest) if high > low else (smallest,)
        return LogAxis(low - air, high + air, start, length, ends)

    def at(self, value: float) -> float:
        """Position in pixels; what lies below the axis (such as 0 seconds) sits at its start."""
        share = (math.log(value) - self.low) / (self.high - self.low) if value > 0 else 0.0
        return self.start + self.length * max(share, 0.0)

    def ticks(self, welcome: Sequence[float], room: float = LABEL_ROOM) -> Sequence[float]:
        """Round numbers on this axis that leave `room` pixels for their labels."""
        chosen: list[float] = []
        for value in welcome:
            inside = self.low <= math.log(value) <= self.high
            if inside and all(abs(self.at(value) - self.at(other)) >= room for other in chosen):
                chosen.append(value)
        if len(chosen) < 2:  # a range so short that it holds no round numbers: name its ends
            return self.ends
        return chosen


@dataclass(frozen=True, slots=True)
class DecibelAxis:
    """A vertical axis in decibels between `top` and `bottom` (pixels), with air for labels above the best value."""

    low: int
    high: int
    step: int
    top: float
    bottom: float

    @staticmethod
    def over(decibels: Sequence[float], top: float, bottom: float) -> DecibelAxis:
        """The axis that holds `decibels` in at most about seven steps."""
        span = max(decibels) - min(decibels)
        step = next((step for step in DECIBELS if span / step <= 6), DECIBELS[-1])
        low = step * math.floor(min(decibels) / step - 0.1)
        high = step * math.ceil(max(decibels) / step + 0.4)
        return DecibelAxis(low, high, step, top, bottom)

    @property
    def levels(self) -> range:
        """Where grid lines lie, in decibels."""
        return range(self.low, self.high + self.step, self.step)

    def at(self, level: float) -> float:
        """Position in pixels."""
        return self.bottom - (level - self.low) / (self.high - self.low) * (self.bottom - self.top)

    def names(self, left: float, right: float) -> list[str]:
        """Both columns of labels: the error ends at `left`, the same height in decibels begins at `right`."""
        parts = [text(left, self.top - 16, "RMSE", "label", "end"), text(right, self.top - 16, "PSNR", "label")]
        for level in self.levels:
            parts.append(text(left, self.at(level) + 4, error(10 ** (-level / 20)), anchor="end"))
            parts.append(text(right, self.at(level) + 4, f"{level} dB"))
        return parts


def panel(
    across: LogAxis, quality: DecibelAxis, label: str, welcome: Sequence[float], name: Callable[[float], str]
) -> list[str]:
    """Grid, ticks and label of one panel; `welcome` are numbers that its horizontal axis may show, called by `name`."""
    left, right, bottom = across.start, across.start + across.length, quality.bottom
    parts = [rule(left, quality.at(level), right, quality.at(level)) for level in quality.levels]
    for value in across.ticks(welcome):
        parts.append(rule(across.at(value), quality.top, across.at(value), bottom))
        parts.append(text(across.at(value), bottom + 20, name(value), anchor="middle"))
    parts.append(rule(left, bottom, right, bottom, "axis"))
    parts.append(text((left + right) / 2, bottom + 44, label, "label", "middle"))
    return parts


def text(x: float, y: float, words: str, kind: str = "note", anchor: str = "start") -> str:
    """Words at a place; `kind` is the class of the style sheet."""
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>'


def rule(x1: float, y1: float, x2: float, y2: float, kind: str = "grid") -> str:
    """A straight line."""
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def line(places: Sequence[tuple[float, float]], kind: str = "curve") -> str:
    """A line through `places`."""
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    return f'<polyline class="{kind}" points="{path}"/>'


def mark(place: tuple[float, float], words: str, kind: str = "point") -> str:
    """A dot; `words` show when the pointer rests on it."""
    x, y = place
    return f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="3.2"><title>{escape(words)}</title></circle>'
