"""The curve of one run: held-out PSNR against training time and iterations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from graings.report.axes import ROUND_COUNTS, ROUND_SECONDS, new_page, new_panel, set_log_x, set_quality_y
from graings.report.figure_files import PAPER, style
from graings.report.formatting import count, duration

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH: Final = 960.0
HEIGHT: Final = 400.0
LEFT, RIGHT, TOP, BOTTOM = 72.0, 900.0, 100.0, 336.0
GAP: Final = 40.0  # between the two panels
COLOR: Final = "#0d6b83"

X_AXES: Final[tuple[tuple[str, str, Sequence[float], Callable[[float], str]], ...]] = (
    ("train_s", "training time", ROUND_SECONDS, duration),
    ("iteration", "iterations", ROUND_COUNTS, count),
)


@style()
def curve_figure(points: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw `points`: mappings with iteration, train_s, psnr, gaussians and anchors, in order.

    Points whose PSNR is None are left out; without any other the figure says that nothing was evaluated.
    """
    figure, page = new_page(WIDTH, HEIGHT, "Held-out error against run time")
    evaluated = [point for point in points if point["psnr"] is not None]
    if not evaluated:
        page.text(WIDTH / 2, HEIGHT / 2, "no held-out view was evaluated", ha="center")
        return figure
    last = evaluated[-1]
    page.text(
        24,
        58,
        f"{last['psnr']:.2f} dB after {duration(last['train_s'])} of training · {last['iteration']:,} iterations · "
        f"{last['gaussians']:,} Gaussians from {last['anchors']:,} anchors",
    )
    decibels = [float(point["psnr"]) for point in evaluated]
    width = (RIGHT - LEFT - GAP) / 2
    lefts = (LEFT, LEFT + width + GAP)
    panels = [new_panel(figure, left, left + width, TOP, BOTTOM) for left in lefts]
    set_quality_y(panels, decibels)
    for axes, (key, label, preferred, name) in zip(panels, X_AXES, strict=True):
        values = [float(point[key]) for point in evaluated]
        set_log_x(axes, values, label, preferred, name)
        places = [max(value, axes.get_xlim()[0]) for value in values]  # 0 s is at the start of the axis
        axes.plot(places, decibels, "o-", color=COLOR, markerfacecolor=PAPER, clip_on=False)
        axes.plot(places[-1], decibels[-1], "o", color=COLOR, clip_on=False)
        axes.annotate(
            f"{last['psnr']:.2f} dB",
            (places[-1], decibels[-1]),
            (3, 8),
            textcoords="offset points",
            ha="right",
            color=COLOR,
            fontweight="bold",
        )
    return figure
