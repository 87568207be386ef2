"""The figure of held-out error against work, for any number of runs, with a table below it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from graings.report.axes import (
    ROUND_COUNTS,
    ROUND_SECONDS,
    line_style,
    new_page,
    new_panel,
    set_log_x,
    set_quality_y,
    shortened,
)
from graings.report.figure_files import INK, NOTE, PAPER, WARNING, style
from graings.report.formatting import count, duration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH: Final = 1200.0
LEFT, RIGHT, TOP, BOTTOM = 72.0, 1140.0, 100.0, 340.0
GAP: Final = 40.0  # between panels
TABLE: Final = 424.0  # upper end of the first row
ROW: Final = 64.0
LINE: Final = 15.0  # height of a line of text

# Left ends of the columns.
NAME_X: Final = 110.0
LAST_X: Final = 330.0
TIMES_X: Final = 484.0
TIME_WIDTH: Final = 78.0
SECONDS_X: Final = 886.0
SECONDS_WIDTH: Final = 290.0
NAME_LENGTH: Final = 30  # letters that fit before the next column

PHASE_COLORS: Final = {"train": "#0d6b83", "evaluation": "#e0a23c", "checkpoint": "#8f6fb8", "other": "#b4b9be"}

X_AXES: Final[tuple[tuple[str, str, Sequence[float], Callable[[float], str]], ...]] = (
    ("train_s", "training time", ROUND_SECONDS, duration),
    ("iteration", "iterations", ROUND_COUNTS, count),
    ("gaussians", "Gaussians", ROUND_COUNTS, count),
)


@style()
def training_figure(parts: Sequence[Mapping[str, Any]]) -> Figure:
    """Held-out error of `parts` (kind training) against training time, iterations and Gaussians.

    Below it a row for each run: its line, the time to each target, and its seconds by phase.
    """
    problems = [f"{part['run']['name']}: {problem}" for part in parts for problem in part["phases"]["problems"]]
    end = TABLE + ROW * len(parts)
    figure, page = new_page(WIDTH, end + 20 + 18 * len(problems), "Held-out error against work")
    runs = f"{len(parts)} run{'s' if len(parts) != 1 else ''}"
    page.text(24, 58, f"{runs} · training time excludes evaluation, checkpoints and loading")
    if any(part["points"] for part in parts):
        _panels(figure, parts)
    else:
        page.text(WIDTH / 2, (TOP + BOTTOM) / 2, "no held-out view was evaluated", ha="center")
    _table(page, parts)
    for i, problem in enumerate(problems):
        page.text(LEFT, end + 14 + 18 * i, problem, color=WARNING)
    return figure


def _panels(figure: Figure, parts: Sequence[Mapping[str, Any]]) -> None:
    points = [point for part in parts for point in part["points"]]
    width = (RIGHT - LEFT - (len(X_AXES) - 1) * GAP) / len(X_AXES)
    lefts = [LEFT + i * (width + GAP) for i in range(len(X_AXES))]
    panels = [new_panel(figure, left, left + width, TOP, BOTTOM) for left in lefts]
    set_quality_y(panels, [point["psnr"] for point in points])
    for axes, (key, label, preferred, name) in zip(panels, X_AXES, strict=True):
        set_log_x(axes, [float(point[key]) for point in points], label, preferred, name)
        start = axes.get_xlim()[0]  # where 0 s is drawn
        for index, part in enumerate(parts):
            x = [max(point[key], start) for point in part["points"]]
            y = [point["psnr"] for point in part["points"]]
            axes.plot(x, y, **line_style(index), markerfacecolor=PAPER, clip_on=False)
            axes.plot(x[-1:], y[-1:], **line_style(index), clip_on=False)


def _table(page: Axes, parts: Sequence[Mapping[str, Any]]) -> None:
    """The legend, with the numbers that a reader compares first."""
    targets = [entry["target_db"] for entry in parts[0]["time_to_psnr"]] if parts else []
    heads = [(LEFT, "run"), (LAST_X, "last evaluation"), (SECONDS_X, "wall-clock time by phase")]
    heads += [(TIMES_X + i * TIME_WIDTH, f"to {target:g} dB") for i, target in enumerate(targets)]
    for x, head in heads:
        page.text(x, TABLE - 14, head, color=INK, fontweight="bold")
    page.plot([LEFT, SECONDS_X + SECONDS_WIDTH], [TABLE - 4, TABLE - 4], color="#9aa0a6", linewidth=0.8)
    for index, part in enumerate(parts):
        y = TABLE + index * ROW + 18
        page.plot([LEFT, LEFT + 14, LEFT + 28], [y - 4, y - 4, y - 4], **line_style(index), markevery=[1])
        page.text(NAME_X, y, shortened(part["run"]["name"], NAME_LENGTH), color=INK)
        page.text(NAME_X, y + LINE, _facts(part))
        if part["points"]:
            last = part["points"][-1]
            page.text(LAST_X, y, f"{last['psnr']:.2f} dB, {duration(last['train_s'])}", color=INK)
            page.text(LAST_X, y + LINE, f"{count(last['gaussians'])} Gaussians")
        for i, entry in enumerate(part["time_to_psnr"]):
            color = NOTE if entry["train_s"] is None else INK
            page.text(TIMES_X + i * TIME_WIDTH, y, _time_to(entry), color=color)
        _seconds(page, part, y)


def _facts(part: Mapping[str, Any]) -> str:
    run, capture = part["run"], part["capture"]
    facts = [run["preset"], f"{capture['width']} x {capture['height']}", f"seed {run['seed']}"]
    return " · ".join([fact for fact in facts if fact] + (["unfinished"] if run["status"] != "finished" else []))


def _time_to(entry: Mapping[str, Any]) -> str:
    """A time, or the side on which it is known to lie."""
    if entry["train_s"] is not None:
        return duration(entry["train_s"])
    if entry["censored_at_s"] is not None:
        return f"> {duration(entry['censored_at_s'])}"
    return f"≤ {duration(entry['at_most_s'])}" if entry["at_most_s"] is not None else "-"


def _seconds(page: Axes, part: Mapping[str, Any], y: float) -> None:
    """A bar of the wall-clock time by phase, the same in words, and below them CPU time or what does not add up."""
    phases, totals = part["phases"], part["totals"]
    seconds = {name: totals[f"{name}_s"] for name in ("train", "evaluation", "checkpoint")}
    seconds["other"] = max(phases["total_s"] - sum(seconds.values()), 0.0)
    total = max(sum(seconds.values()), 1e-9)
    x = SECONDS_X
    for name, value in seconds.items():
        width = SECONDS_WIDTH * value / total
        page.barh(y - 5, width, height=9, left=x, color=PHASE_COLORS[name])
        x += width
    words = [f"{name} {duration(value)}" for name, value in seconds.items()]
    page.text(SECONDS_X, y + LINE, " · ".join(words[:2]))
    page.text(SECONDS_X, y + 2 * LINE - 1, " · ".join(words[2:]))
    if phases["problems"]:
        page.text(SECONDS_X, y + 3 * LINE - 2, "the phases do not add up", color=WARNING)
    elif totals["train_cpu_s"] is not None:
        page.text(SECONDS_X, y + 3 * LINE - 2, f"CPU time of training {duration(totals['train_cpu_s'])}")
