"""Plots: the pictures of a work-precision report, any number of runs in each.

Handwritten SVG in the style of a run's own curve. Takes the parts of the document as they are; knows nothing of files
or of how the numbers came about.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from graings.report.drawing import COUNTS, SECONDS, DecibelAxis, LogAxis, line, mark, panel, rule, sheet, svg, text
from graings.report.formatting import count, duration
from graings.report.report import point_words

WIDTH: Final = 1200.0
LEFT, RIGHT, TOP, BOTTOM = 66.0, 1142.0, 100.0, 340.0
GUTTER: Final = 40.0
PANEL: Final = (RIGHT - LEFT - 2 * GUTTER) / 3
TABLE: Final = BOTTOM + 84.0
ROW: Final = 60.0
LAST: Final = 316.0  # left ends of the columns: last evaluation, times to targets (and their distance), seconds
TIMES: Final = 470.0
STEP: Final = 76.0
BAR: Final = 880.0
NAME_LENGTH: Final = 30  # letters that fit before the second column

# One colour per run, told apart also without red and green; the second of each pair is for a dark page. A ninth run
# begins again, dashed.
COLOURS: Final = (
    *(("#0d6b83", "#62c6da"), ("#c2571a", "#f0935a"), ("#6a4fa3", "#b39ddb"), ("#3d7a28", "#8fce74")),
    *(("#b03060", "#f08cae"), ("#8a6d00", "#e0c04c"), ("#35516e", "#9db8d6"), ("#7a5548", "#c9a595")),
)
LIGHT_RULES: Final = """\
.swatch { stroke-width: 3; }
.dashed { stroke-dasharray: 6 4; }
.warning { fill: #a33a12; }
.train { fill: #0d6b83; }
.evaluation { fill: #e0a23c; }
.checkpoint { fill: #8f6fb8; }
.other { fill: #b4b9be; }
"""
DARK_RULES: Final = """\
  .warning { fill: #f0935a; }
  .train { fill: #62c6da; }
  .other { fill: #5b636b; }
"""


def inks(dark: bool) -> str:
    """Rules for the colours of runs in one theme."""
    chosen = [pair[dark] for pair in COLOURS]
    return "".join(f".c{i} {{ stroke: {ink}; }}\n.f{i} {{ fill: {ink}; }}\n" for i, ink in enumerate(chosen))


SHEET: Final = sheet(LIGHT_RULES + inks(False), DARK_RULES + inks(True))


def colour(index: int) -> str:
    """The classes of the line of run `index`."""
    return f"c{index % len(COLOURS)}" + (" dashed" if index // len(COLOURS) % 2 else "")


def filled(index: int) -> str:
    """The classes of the last mark of run `index`: its line's colour, filled."""
    return f"c{index % len(COLOURS)} f{index % len(COLOURS)}"


def training_svg(parts: Sequence[Mapping[str, Any]]) -> str:
    """Held-out error of `parts` (kind training) against training time, iterations and Gaussians.

    Below it a row for each run: its line, the time to each target, and where its seconds went.
    """
    shown = [(index, part) for index, part in enumerate(parts) if part["points"]]
    title = "Held-out error against work"
    body = [text(LEFT, 36, title, "title"), text(LEFT, 58, _caption(parts))]
    if shown:
        body += _panels(shown)
    else:
        body.append(text(WIDTH / 2, (TOP + BOTTOM) / 2, "no held-out view was evaluated", anchor="middle"))
    body += _table(parts)
    problems = [f"{p['run']['name']}: {words}" for p in parts for words in p["phases"]["problems"]]
    below = TABLE + ROW * len(parts) + 14
    body += [text(LEFT, below + 18 * i, words, "warning") for i, words in enumerate(problems)]
    return svg(WIDTH, TABLE + ROW * len(parts) + 20 + 18 * len(problems), title, body, SHEET)


def _caption(parts: Sequence[Mapping[str, Any]]) -> str:
    runs = "1 run" if len(parts) == 1 else f"{len(parts)} runs"
    return f"{runs}, one seed each · training time leaves out evaluation, checkpoints and loading · RMSE at that PSNR"


def _panels(shown: Sequence[tuple[int, Mapping[str, Any]]]) -> list[str]:
    points = [point for _, part in shown for point in part["points"]]
    quality = DecibelAxis.over([point["psnr"] for point in points], TOP, BOTTOM)
    parts = quality.names(LEFT - 10, RIGHT + 10)
    panels: tuple[tuple[str, str, Sequence[float], Callable[[float], str]], ...] = (
        ("train_s", "training time", SECONDS, duration),
        ("iteration", "iterations", COUNTS, count),
        ("gaussians", "Gaussians", COUNTS, count),
    )
    for place, (key, label, welcome, name) in enumerate(panels):
        left = LEFT + place * (PANEL + GUTTER)
        axis = LogAxis.over([float(point[key]) for point in points], left, PANEL)
        parts += panel(axis, quality, label, welcome, name)
        for index, part in shown:
            parts += _curve(part, index, [axis.at(p[key]) for p in part["points"]], quality)
    return parts


def _curve(part: Mapping[str, Any], index: int, across: Sequence[float], quality: DecibelAxis) -> list[str]:
    places = [(x, quality.at(point["psnr"])) for x, point in zip(across, part["points"], strict=True)]
    name = part["run"]["name"]
    kinds = [f"point c{index % len(COLOURS)}"] * (len(places) - 1) + [f"point {filled(index)}"]
    return [
        line(places, f"curve {colour(index)}"),
        *(
            mark(place, f"{name}\n{point_words(point)}", kind)
            for place, point, kind in zip(places, part["points"], kinds, strict=True)
        ),
    ]


def _table(parts: Sequence[Mapping[str, Any]]) -> list[str]:
    """The legend, with the numbers a reader would look for first."""
    targets = [entry["target_db"] for entry in parts[0]["time_to_psnr"]] if parts else []
    head = TABLE - 14
    body = [text(LEFT, head, "run", "label"), text(LAST, head, "last evaluation", "label")]
    body += [text(TIMES + i * STEP, head, f"{target:g} dB", "label") for i, target in enumerate(targets)]
    body += [text(BAR, head, "where the seconds went", "label"), rule(LEFT, TABLE - 4, RIGHT, TABLE - 4, "axis")]
    for index, part in enumerate(parts):
        y = TABLE + index * ROW + 18
        last = part["points"][-1] if part["points"] else None
        body.append(rule(LEFT, y - 4, LEFT + 24, y - 4, f"swatch {colour(index)}"))
        body.append(text(LEFT + 34, y, _shortened(part["run"]["name"]), "label"))
        body.append(text(LEFT + 34, y + 15, _facts(part)))
        if last is not None:
            body.append(text(LAST, y, f"{last['psnr']:.2f} dB, {duration(last['train_s'])}", "label"))
            body.append(text(LAST, y + 15, f"{count(last['gaussians'])} Gaussians"))
        body += [
            text(TIMES + i * STEP, y, _reached(entry), "label" if entry["train_s"] is not None else "note")
            for i, entry in enumerate(part["time_to_psnr"])
        ]
        body += _seconds(part, y)
    return body


def _facts(part: Mapping[str, Any]) -> str:
    run, capture = part["run"], part["capture"]
    facts = [run["preset"], f"{capture['width']} x {capture['height']}", f"seed {run['seed']}"]
    return " · ".join([fact for fact in facts if fact] + (["unfinished"] if run["status"] != "finished" else []))


def _shortened(name: str) -> str:
    """The end of a long name: runs of one series differ there."""
    return name if len(name) <= NAME_LENGTH else f"…{name[1 - NAME_LENGTH :]}"


def _reached(entry: Mapping[str, Any]) -> str:
    """A time, or the side on which it is known to lie."""
    if entry["train_s"] is not None:
        return duration(entry["train_s"])
    if entry["censored_at_s"] is not None:
        return f"> {duration(entry['censored_at_s'])}"
    return f"≤ {duration(entry['at_most_s'])}" if entry["at_most_s"] is not None else "-"


def _seconds(part: Mapping[str, Any], y: float) -> list[str]:
    """A bar of the whole clock, and in words what is not training and what processors did, or what does not add up."""
    spent, totals = part["phases"], part["totals"]
    named = {
        "train": totals["train_s"],
        "evaluation": totals["evaluation_s"],
        "checkpoint": totals["checkpoint_s"],
    }
    named["other"] = max(spent["total_s"] - sum(named.values()), 0.0)
    whole = max(sum(named.values()), 1e-9)
    parts, x = [], BAR
    for kind, seconds in named.items():
        width = (RIGHT + 48 - BAR) * seconds / whole
        parts.append(f'<rect class="{kind}" x="{x:.1f}" y="{y - 11:.1f}" width="{width:.1f}" height="9"/>')
        x += width
    said = [f"{kind} {duration(seconds)}" for kind, seconds in named.items()]
    parts += [text(BAR, y + 13, " · ".join(said[:2])), text(BAR, y + 27, " · ".join(said[2:]))]
    if spent["problems"]:
        parts.append(text(BAR, y + 41, "the phases do not add up", "warning"))
    elif totals["train_cpu_s"] is not None:
        parts.append(text(BAR, y + 41, f"train, all processors {duration(totals['train_cpu_s'])}"))
    return parts
