"""The figure of render error against the time of a frame, a panel for each finished model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from graings.report.axes import (
    line_style,
    log_limits,
    log_ticks,
    new_page,
    new_panel,
    right_scale,
    scale_names,
    set_log_x,
    shortened,
)
from graings.report.figure_files import INK, PAPER, style
from graings.report.formatting import error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH: Final = 1200.0
HEAD: Final = 80.0
PANEL_HEIGHT: Final = 420.0
COLUMNS: Final = ((78.0, 540.0), (678.0, 1140.0))  # left and right end of the two panels of a row
LABEL_HEIGHT: Final = 13.0
LETTER_WIDTH: Final = 6.3
NAME_LENGTH: Final = 70  # letters that fit above one of two panels

# Options of a setting by the name of the sweep that changes them, with their label.
SWEEPS: Final = {
    "resolution": ("scale", "resolution"),
    "alpha_min": ("alpha_min", "alpha cut-off"),
    "transmittance_min": ("transmittance_min", "transmittance cut-off"),
}
_DIGITS: Final = (1, 5, 2, 3, 4, 6, 7, 8, 9, 1.5, 2.5, 1.2)
MILLISECONDS: Final = tuple(digit * 10.0**power for digit in _DIGITS for power in range(-2, 6))
ERRORS: Final = tuple(10.0**-power for power in range(10))


@style()
def render_figure(parts: Sequence[Mapping[str, Any]]) -> Figure:
    """RMSE against milliseconds of a frame for `parts` (kind render), with the Pareto front behind each."""
    rows = max((len(parts) + 1) // 2, 1)
    height = HEAD + PANEL_HEIGHT * rows
    figure, page = new_page(WIDTH, height, "Render error against time")
    if not parts:
        page.text(WIDTH / 2, HEAD + 40, "no model was rendered", ha="center")
        return figure
    for index, part in enumerate(parts):
        left, right = COLUMNS[index % 2] if len(parts) > 1 else (COLUMNS[0][0], COLUMNS[1][1])
        top = HEAD + PANEL_HEIGHT * (index // 2)
        page.text(left, top + 16, shortened(part["run"]["name"], NAME_LENGTH), color=INK)
        page.text(left, top + 33, _facts(part))
        axes = new_panel(figure, left, right, top + 76, top + PANEL_HEIGHT - 66)
        _plot(axes, part)
        _name_points(page, axes, part["points"])
    handles, labels = figure.axes[1].get_legend_handles_labels()
    place = ((24 - 5) / WIDTH, 1 - 46 / height)
    figure.legend(handles, labels, loc="upper left", bbox_to_anchor=place, ncols=len(labels), borderpad=0.2)
    return figure


def _plot(axes: Axes, part: Mapping[str, Any]) -> None:
    points = part["points"]
    times = [point["ms"]["median"] for point in points]
    errors = [point["err"]["rmse"] for point in points]
    set_log_x(axes, times, "milliseconds of a frame", MILLISECONDS, "{:.4g}".format)
    axes.set_xlim(right=axes.get_xlim()[1] * (axes.get_xlim()[1] / axes.get_xlim()[0]) ** 0.06)  # room for labels
    axes.set_yscale("log")
    axes.set_ylim(log_limits(errors))
    levels = log_ticks(errors, axes.get_window_extent().height, ERRORS, room=24)
    axes.set_yticks(levels, [error(level) for level in levels])
    axes.set_yticks([], minor=True)
    right_scale(axes, levels, [_decibels(level) for level in levels])
    scale_names(axes, axes, "RMSE", "PSNR")
    errors = [max(value, axes.get_ylim()[0]) for value in errors]  # no error at all is at the bottom of the axis
    for index, (sweep, (option, label)) in enumerate(SWEEPS.items()):
        # Sorted by the option, so that the line shows the trade-off and not the order of the list.
        swept = [i for i, point in enumerate(points) if point["setting"]["sweep"] in (sweep, "default")]
        swept.sort(key=lambda i: points[i]["setting"][option])
        line = {**line_style(index), "markerfacecolor": PAPER, "label": label, "clip_on": False}
        axes.plot([times[i] for i in swept], [errors[i] for i in swept], **line)
    front = part["pareto"]
    # Between two points of the front nothing better than the faster one is known: stairs.
    stairs: dict[str, Any] = {"drawstyle": "steps-post", "color": "#d3d6d4", "linewidth": 5, "zorder": 1}
    axes.plot([times[i] for i in front], [errors[i] for i in front], **stairs, label="Pareto front")
    default = [i for i, point in enumerate(points) if point["setting"]["sweep"] == "default"]
    dot: dict[str, Any] = {"color": INK, "markersize": 6, "zorder": 3, "clip_on": False}
    axes.plot([times[i] for i in default], [errors[i] for i in default], "o", **dot, label="default settings")


def _facts(part: Mapping[str, Any]) -> str:
    views, threads = len(part["views"]["names"]), part["machine"]["threads"]
    size, networks = part["size"], part["points"][0]["ms"]["networks"]
    noisy = " · noisy machine" if part["noisy"] else ""
    return (
        f"{views} {part['views']['split']} views of {size['width']} x {size['height']} · "
        f"{threads} thread{'' if threads == 1 else 's'} · networks take {networks:.3g} ms of a frame{noisy}"
    )


def _decibels(rmse: float) -> str:
    exponent = f"{rmse:e}".partition("e")
    # Powers of ten are whole decibels; the ends of a short axis need a digit.
    return f"{-20 * int(exponent[2])} dB" if float(exponent[0]) == 1 else ""


def _setting_name(setting: Mapping[str, Any]) -> str:
    """The value of the option that is swept, as short as a label must be."""
    if setting["sweep"] == "default":
        return "default"
    value = setting[SWEEPS[setting["sweep"]][0]]
    return f"1/{1 / value:g}" if 1e-4 < value < 1 and (1 / value).is_integer() else f"{value:.0e}" if value else "0"


def _name_points(page: Axes, axes: Axes, points: Sequence[Mapping[str, Any]]) -> None:
    """Names to the upper right of the marks, where no line of a sweep goes, pushed up until they cover nothing."""
    low = axes.get_ylim()[0]
    data = [(point["ms"]["median"], max(point["err"]["rmse"], low)) for point in points]
    places = page.transData.inverted().transform(axes.transData.transform(data))
    covered = [(x - 4, x + 4, y + 4) for x, y in places]  # left, right and lower end
    for i in sorted(range(len(points)), key=lambda i: -places[i][1]):
        x, y = places[i][0] + 6, places[i][1] - 5
        name = _setting_name(points[i]["setting"])
        end = x + LETTER_WIDTH * len(name)
        while any(abs(y - bottom) < LABEL_HEIGHT and x < right and left < end for left, right, bottom in covered):
            y -= 2
        covered.append((x, end, y))
        page.text(x, y, name, fontsize=7.5)
