"""Plot: an ablation as a drawing, each row's distance to the full model in decibels.

Filled dots are seeds, the bar is their mean, the hollow diamond is the paper's difference. Knows nothing of runs; it
is told the table's document.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any, Final

from graings.ablation.rows import FULL
from graings.ablation.table import signed
from graings.report.drawing import rule, sheet, svg, text

WIDTH: Final = 960
LEFT, RIGHT, TOP = 200.0, 830.0, 112.0
LINE: Final = 36.0  # height of a row
SPREAD: Final = 4.0  # seeds of equal difference lie this far apart, so that none hides another
STEPS: Final = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # decibels between grid lines
GRID_LINES: Final = 8

LIGHT: Final = """\
.zero { stroke: #20252a; stroke-width: 1.5; }
.seed { fill: #0d6b83; fill-opacity: 0.55; }
.mean { stroke: #0d6b83; stroke-width: 3; stroke-linecap: round; }
.theirs { fill: #fcfcfb; stroke: #b3541e; stroke-width: 1.8; }
"""
DARK: Final = """\
  .zero { stroke: #e8eaec; }
  .seed { fill: #62c6da; }
  .mean { stroke: #62c6da; }
  .theirs { fill: #16191c; stroke: #f0a070; }
"""


def differences_svg(table: Mapping[str, Any]) -> str:
    """Draw a document of `graings.ablation.table`; rows that nothing is known of yet say so."""
    rows = [row for row in table["rows"] if row["name"] != FULL]
    bottom = TOP + LINE * max(len(rows), 1)
    title = f"What each part is worth on {table['capture']['name']}"
    parts = [text(24, 36, title, "title"), text(24, 58, _summary(table)), *_legend(84)]
    low, high, step = _range(rows)

    def across(decibels: float) -> float:
        return LEFT + (decibels - low) / (high - low) * (RIGHT - LEFT)

    for index in range(round(low / step), round(high / step) + 1):
        level = index * step
        parts.append(rule(across(level), TOP, across(level), bottom, "grid" if index else "zero"))
        parts.append(text(across(level), bottom + 20, signed(level) if index else "full", anchor="middle"))
    parts.append(text((LEFT + RIGHT) / 2, bottom + 44, "PSNR above the full model, dB", "label", "middle"))
    for index, row in enumerate(rows):
        middle = TOP + LINE * (index + 0.5)
        parts.append(text(LEFT - 14, middle + 4, row["label"], "label", "end"))
        theirs = row["paper"]["difference"] if row["paper"] is not None else None
        if theirs is not None:
            parts.append(_diamond(across(theirs), middle, f"paper: {signed(theirs)} dB"))
        mean = row["difference"]["mean"]
        if mean is None:
            parts.append(text(RIGHT + 14, middle + 4, "not measured yet"))
            continue
        parts.append(rule(across(mean), middle - 11, across(mean), middle + 11, "mean"))
        parts += _seeds(row["runs"], across, middle)
        parts.append(text(RIGHT + 14, middle + 4, f"{signed(mean)} dB", "value"))
    return svg(WIDTH, round(bottom + 64), title, parts, sheet(LIGHT, DARK))


def _summary(table: Mapping[str, Any]) -> str:
    capture, options = table["capture"], table["options"]
    full = next((row["psnr"]["mean"] for row in table["rows"] if row["name"] == FULL), None)
    start = "full not measured yet" if full is None else f"full {full:.2f} dB"
    seeds = len(table["seeds"])
    return (
        f"{start} on {capture['views']} validation views · {capture['width']} x {capture['height']} · "
        f"{options['iterations']:,} iterations · {seeds} {'seed' if seeds == 1 else 'seeds'}"
    )


def _legend(y: float) -> list[str]:
    return [
        f'<circle class="seed" cx="30" cy="{y - 4:.1f}" r="4"/>',
        text(42, y, "one seed"),
        rule(122, y - 11, 122, y + 3, "mean"),
        text(132, y, "mean"),
        _diamond(198, y - 4, "the paper's"),
        text(210, y, "the paper's difference: mean of eight scenes, full length"),
    ]


def _range(rows: Sequence[Mapping[str, Any]]) -> tuple[float, float, float]:
    """Ends of the axis and the step of its grid, in dB, around zero, our differences and the paper's."""
    values = [0.0]
    for row in rows:
        values += [run["difference"] for run in row["runs"] if run["difference"] is not None]
        values += [row["paper"]["difference"]] if row["paper"] is not None else []
    span = max(values) - min(values)
    step = next((step for step in STEPS if span / step <= GRID_LINES), math.ceil(span / GRID_LINES))
    return step * (math.floor(min(values) / step - 0.2)), step * (math.ceil(max(values) / step + 0.2)), step


def _seeds(runs: Sequence[Mapping[str, Any]], across: Callable[[float], float], middle: float) -> list[str]:
    known = [run for run in runs if run["difference"] is not None]
    parts = []
    for index, run in enumerate(known):
        y = middle + SPREAD * (index - (len(known) - 1) / 2)
        words = f"seed {run['seed']}: {signed(run['difference'])} dB, PSNR {run['psnr']:.2f} dB"
        parts.append(
            f'<circle class="seed" cx="{across(run["difference"]):.1f}" cy="{y:.1f}" r="4">'
            f"<title>{escape(words)}</title></circle>"
        )
    return parts


def _diamond(x: float, y: float, words: str) -> str:
    corners = " ".join(f"{x + dx:.1f},{y + dy:.1f}" for dx, dy in ((0, -6), (6, 0), (0, 6), (-6, 0)))
    return f'<polygon class="theirs" points="{corners}"><title>{escape(words)}</title></polygon>'
