"""The figure of an ablation: each row's difference to the full model in dB, beside the paper's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from graings.ablation.rows import FULL
from graings.ablation.table import signed
from graings.report.axes import new_page, new_panel, right_scale
from graings.report.figure_files import INK, PAPER, style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH: Final = 960.0
LEFT, RIGHT, TOP = 212.0, 830.0, 112.0
ROW: Final = 36.0  # height of a row in pixels
SEED_DISTANCE: Final = 0.11  # of a row, between the dots of two seeds, so that equal ones do not cover each other
OURS: Final = "#0072b2"
PAPERS: Final = "#d55e00"

Place = tuple[float, float]  # difference in dB and row


@style()
def differences_figure(table: Mapping[str, Any]) -> Figure:
    """Draw a document of `graings.ablation.table`; rows without a finished run are marked as not measured."""
    rows = [row for row in table["rows"] if row["name"] != FULL]
    bottom = TOP + ROW * max(len(rows), 1)
    figure, page = new_page(WIDTH, bottom + 64, f"Ablation on {table['capture']['name']}")
    page.text(24, 58, _summary(table))
    axes = new_panel(figure, LEFT, RIGHT, TOP, bottom)
    means = [(row["difference"]["mean"], y) for y, row in enumerate(rows) if row["difference"]["mean"] is not None]
    papers = [(row["paper"]["difference"], y) for y, row in enumerate(rows) if row["paper"] is not None]
    seeds = [place for y, row in enumerate(rows) for place in _seeds(row, y)]
    paper = "the paper's difference: mean of eight scenes, full length"
    axes.axvline(0, color=INK, linewidth=1.2)
    axes.plot(*_columns(seeds), "o", color=OURS, alpha=0.55, markersize=6, markeredgewidth=0, label="one seed")
    axes.plot(*_columns(means), "|", color=OURS, markersize=16, markeredgewidth=2.4, label="mean")
    axes.plot(*_columns(papers), "D", color=PAPERS, markerfacecolor=PAPER, markersize=6.5, label=paper)
    axes.set_ylim(max(len(rows), 1) - 0.5, -0.5)
    axes.set_yticks(range(len(rows)), [row["label"] for row in rows], color=INK)
    axes.grid(visible=False, axis="y")
    right_scale(axes, range(len(rows)), [_mean(row) for row in rows])
    values = [0.0, *(value for value, _ in (*seeds, *papers))]
    margin = max(0.06 * (max(values) - min(values)), 0.05)
    axes.set_xlim(min(values) - margin, max(values) + margin)
    axes.locator_params(axis="x", nbins=10, steps=[1, 2, 5, 10])
    axes.xaxis.set_major_formatter(lambda value, _: signed(value) if round(value, 6) else "full")
    axes.set_xlabel("PSNR relative to the full model, dB")
    place = (14 / WIDTH, 1 - 74 / (bottom + 64))
    figure.legend(loc="upper left", bbox_to_anchor=place, ncols=3, borderpad=0, borderaxespad=0)
    return figure


def _seeds(row: Mapping[str, Any], y: float) -> list[Place]:
    """A place for each finished run; those of one row lie at different heights."""
    differences = [run["difference"] for run in row["runs"] if run["difference"] is not None]
    first = y - SEED_DISTANCE * (len(differences) - 1) / 2
    return [(value, first + SEED_DISTANCE * i) for i, value in enumerate(differences)]


def _columns(places: Sequence[Place]) -> tuple[list[float], list[float]]:
    return [x for x, _ in places], [y for _, y in places]


def _mean(row: Mapping[str, Any]) -> str:
    mean = row["difference"]["mean"]
    return "not measured yet" if mean is None else f"{signed(mean)} dB"


def _summary(table: Mapping[str, Any]) -> str:
    capture, options = table["capture"], table["options"]
    full = next((row["psnr"]["mean"] for row in table["rows"] if row["name"] == FULL), None)
    psnr = "full not measured yet" if full is None else f"full {full:.2f} dB"
    seeds = len(table["seeds"])
    return (
        f"{psnr} on {capture['views']} validation views · {capture['width']} x {capture['height']} · "
        f"{options['iterations']:,} iterations · {seeds} {'seed' if seeds == 1 else 'seeds'}"
    )
