"""The parts that figures share: a page in pixels, panels on it, logarithmic axes and the axis of quality.

The axis of quality has two scales for the same height: PSNR in dB, and RMSE = 10 ** (-PSNR / 20).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

from graings.report.figure_files import INK, PIXELS_PER_INCH
from graings.report.formatting import error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Round numbers for logarithmic axes, the preferred ones first.
ROUND_COUNTS: Final = tuple(digit * 10.0**power for digit in (1, 5, 2) for power in range(8))
ROUND_SECONDS: Final = (
    *(1, 10, 60, 600, 3600, 36_000, 360_000, 0.1, 0.01, 0.001),
    *(30, 1800, 18_000, 5, 300, 180_000, 0.5, 0.05),
    *(2, 20, 120, 1200, 7200, 72_000, 0.2, 0.02),
)
DECIBEL_STEPS: Final = (1, 2, 5, 10, 20)  # between grid lines

# Okabe and Ito's palette for colour-blind readers, without its yellow, which is too light for lines on white.
LINE_COLORS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
MARKERS: Final = "osD^vPX*"


def line_style(index: int) -> dict[str, Any]:
    """Colour, marker and dashes of line `index`: distinct for the first 56 lines."""
    dashes = "-" if index // len(LINE_COLORS) % 2 == 0 else (0, (3, 1.5))
    return {
        "color": LINE_COLORS[index % len(LINE_COLORS)],
        "marker": MARKERS[index % len(MARKERS)],
        "linestyle": dashes,
    }


def new_page(width: float, height: float, title: str) -> tuple[Figure, Axes]:
    """A figure of `width` x `height` pixels, and axes over all of it whose data are pixels from the upper left."""
    from matplotlib.figure import Figure

    figure = Figure((width / PIXELS_PER_INCH, height / PIXELS_PER_INCH), dpi=PIXELS_PER_INCH)
    figure.set_label(title)
    page = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0), zorder=1)  # text above the panels
    page.set_axis_off()
    page.text(24, 36, title, fontsize=13, fontweight="bold", color=INK)
    return figure, page


def new_panel(figure: Figure, left: float, right: float, top: float, bottom: float) -> Axes:
    """Axes between these pixels of the page."""
    width, height = figure.get_size_inches() * PIXELS_PER_INCH
    return figure.add_axes((left / width, 1 - bottom / height, (right - left) / width, (bottom - top) / height))


def log_limits(values: Sequence[float]) -> tuple[float, float]:
    """Ends of a logarithmic axis that holds `values`; values that are not positive have no place on it."""
    positive = [value for value in values if value > 0] or [1.0]
    low, high = min(positive), max(positive)
    margin = (high / low) ** 0.04 if high > low else math.e
    return low / margin, high * margin


def log_ticks(values: Sequence[float], pixels: float, preferred: Sequence[float], room: float = 46.0) -> list[float]:
    """Values of `preferred` for an axis of `log_limits(values)` whose labels lie at least `room` pixels apart.

    The extreme values themselves where the axis holds fewer than two of them.
    """
    low, high = log_limits(values)
    distance = room / pixels * math.log(high / low)
    ticks: list[float] = []
    for value in preferred:
        if low <= value <= high and all(abs(math.log(value / other)) >= distance for other in ticks):
            ticks.append(value)
    positive = [value for value in values if value > 0] or [1.0]
    return ticks if len(ticks) > 1 else sorted({min(positive), max(positive)})


def set_log_x(
    axes: Axes, values: Sequence[float], label: str, preferred: Sequence[float], name: Callable[[float], str]
) -> None:
    """A logarithmic horizontal axis over `values` with ticks at numbers of `preferred`, each written by `name`."""
    axes.set_xscale("log")
    axes.set_xlim(log_limits(values))
    ticks = log_ticks(values, axes.get_window_extent().width, preferred)
    axes.set_xticks(ticks, [name(tick) for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel(label)


def set_quality_y(panels: Sequence[Axes], decibels: Sequence[float]) -> None:
    """One vertical axis for `panels` side by side: PSNR at the left of the first, RMSE at the right of the last."""
    span = max(decibels) - min(decibels)
    step = next((step for step in DECIBEL_STEPS if span / step <= 6), DECIBEL_STEPS[-1])
    low = step * math.floor(min(decibels) / step - 0.1)
    high = step * math.ceil(max(decibels) / step + 0.4)  # the last value is written above its point
    levels = range(low, high + step, step)
    for axes in panels:
        axes.set_ylim(low, levels[-1])
        axes.set_yticks(levels, [f"{level} dB" for level in levels])
        axes.tick_params(labelleft=axes is panels[0])
    right_scale(panels[-1], levels, [error(10 ** (-level / 20)) for level in levels])
    scale_names(panels[0], panels[-1], "PSNR", "RMSE")


def right_scale(axes: Axes, places: Sequence[float], labels: Sequence[str]) -> None:
    """Labels at the right of `axes`, at heights in its data."""
    for place, label in zip(places, labels, strict=True):
        axes.annotate(label, (1, place), (6, 0), axes.get_yaxis_transform(), "offset points", va="center_baseline")


def scale_names(first: Axes, last: Axes, left: str, right: str) -> None:
    """What the labels at the left of `first` and at the right of `last` are, above them."""
    for axes, x, name, align in ((first, 0, left, "right"), (last, 1, right, "left")):
        offset = (6 if x else -6, 14)
        axes.annotate(name, (x, 1), offset, "axes fraction", "offset points", ha=align, color=INK)


def shortened(name: str, length: int) -> str:
    """The end of a name that is longer than `length`: runs of one series differ there."""
    return name if len(name) <= length else f"…{name[1 - length :]}"
