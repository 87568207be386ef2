"""RenderPlot: error against milliseconds of a finished model, a panel for each run.

Handwritten SVG. Takes the parts of the document as they are; knows nothing of how they were measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from graings.report.drawing import LogAxis, line, mark, rule, sheet, svg, text
from graings.report.formatting import error
from graings.report.plots import colour, filled, inks

WIDTH: Final = 1200.0
HEAD: Final = 80.0
PANEL_HEIGHT: Final = 420.0
COLUMNS: Final = ((70.0, 540.0), (670.0, 1140.0))  # left and right end of the two panels of a row; one spans both
LABEL_HEIGHT: Final = 13.0

SWEEPS: Final = {
    "resolution": "resolution",
    "alpha_min": "least alpha",
    "transmittance_min": "least transmittance",
}
# The cut-offs change a frame by little: below the round numbers any with two digits is welcome.
_DIGITS: Final = (1, 5, 2, 3, 4, 6, 7, 8, 9, 1.5, 2.5, *(tenths / 10 for tenths in range(11, 100)))
MILLISECONDS: Final = tuple(digit * 10.0**power for digit in _DIGITS for power in range(-2, 6))
ERRORS: Final = tuple(10.0**-power for power in range(10))
LIGHT_RULES: Final = """\
.front { fill: none; stroke: #d9dbda; stroke-width: 7; stroke-linejoin: round; }
.small { font-size: 10.5px; }
"""
DARK_RULES: Final = "  .front { stroke: #33383e; }\n"
SHEET: Final = sheet(LIGHT_RULES + inks(False), DARK_RULES + inks(True))


def render_svg(parts: Sequence[Mapping[str, Any]]) -> str:
    """Error against milliseconds of a frame for `parts` (kind render), with the Pareto front behind each."""
    title = "Render error against time"
    body = [text(COLUMNS[0][0], 36, title, "title"), *_legend()]
    if not parts:
        body.append(text(WIDTH / 2, HEAD + 40, "no model was drawn", anchor="middle"))
    for index, part in enumerate(parts):
        left, right = COLUMNS[index % 2] if len(parts) > 1 else (COLUMNS[0][0], COLUMNS[1][1])
        body += _panel(part, left, right, HEAD + PANEL_HEIGHT * (index // 2))
    rows = max((len(parts) + 1) // 2, 1)
    return svg(WIDTH, HEAD + PANEL_HEIGHT * rows, title, body, SHEET)


def _legend() -> list[str]:
    x, parts = COLUMNS[0][0], []
    for index, name in enumerate(SWEEPS.values()):
        parts += [rule(x, 54, x + 24, 54, f"curve {colour(index)}"), text(x + 32, 58, name, "label")]
        x += 60 + 7 * len(name)
    parts += [rule(x, 54, x + 24, 54, "front"), text(x + 32, 58, "Pareto front", "label")]
    parts += [mark((x + 140, 54), "the default setting", f"point {filled(0)}"), text(x + 152, 58, "default", "label")]
    return parts


def _panel(part: Mapping[str, Any], left: float, right: float, above: float) -> list[str]:
    top, bottom = above + 60, above + PANEL_HEIGHT - 70
    points = part["points"]
    across = LogAxis.over([p["ms"]["median"] for p in points], left, right - left - 40)  # labels need room to the right
    up = LogAxis.over([p["err"]["rmse"] for p in points], bottom, top - bottom)
    parts = [
        text(left, above + 16, part["run"]["name"], "label"),
        text(left, above + 33, _facts(part)),
        text(left - 8, top - 10, "RMSE", "label", "end"),
        text(right + 8, top - 10, "PSNR", "label"),
    ]
    for level in up.ticks(ERRORS, 24):
        y = up.at(level)
        parts += [rule(left, y, right, y), text(left - 8, y + 4, error(level), anchor="end")]
        parts.append(text(right + 8, y + 4, _decibels(level)))
    for value in across.ticks(MILLISECONDS):
        x = across.at(value)
        parts += [rule(x, top, x, bottom), text(x, bottom + 20, f"{value:.3g}", anchor="middle")]
    parts.append(rule(left, bottom, right, bottom, "axis"))
    parts.append(text((left + right) / 2, bottom + 44, "milliseconds of a frame", "label", "middle"))
    places = [(across.at(p["ms"]["median"]), up.at(p["err"]["rmse"])) for p in points]
    parts.append(line(_steps([places[i] for i in part["pareto"]]), "front"))
    for index, sweep in enumerate(SWEEPS):
        mine = [i for i, point in enumerate(points) if point["setting"]["sweep"] in (sweep, "default")]
        # Along the swept quantity, so that the line shows the trade and not the order of the list.
        mine.sort(key=lambda i: points[i]["setting"]["scale" if sweep == "resolution" else sweep])
        parts.append(line([places[i] for i in mine], f"curve {colour(index)}"))
        others = [i for i in mine if points[i]["setting"]["sweep"] == sweep]
        parts += [mark(places[i], _words(points[i]), f"point c{index}") for i in others]
    parts += [mark(places[i], _words(p), f"point {filled(0)}") for i, p in enumerate(points) if _is_default(p)]
    return parts + _labels(points, places)


def _facts(part: Mapping[str, Any]) -> str:
    views, threads = len(part["views"]["names"]), part["machine"]["threads"]
    size, networks = part["size"], part["points"][0]["ms"]["networks"]
    noisy = " · noisy machine" if part["noisy"] else ""
    return (
        f"{views} {part['views']['split']} views of {size['width']} x {size['height']} · "
        f"{threads} thread{'' if threads == 1 else 's'} · {networks:.3g} ms of each are the networks{noisy}"
    )


def _decibels(rmse: float) -> str:
    exponent = f"{rmse:e}".partition("e")
    # Powers of ten are whole decibels; the ends of a short axis need a digit.
    return f"{-20 * int(exponent[2])} dB" if float(exponent[0]) == 1 else ""


def _steps(front: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The front as stairs: between two of its points nothing better than the cheaper one is known."""
    stairs: list[tuple[float, float]] = []
    for x, y in front:
        if stairs:
            stairs.append((x, stairs[-1][1]))
        stairs.append((x, y))
    return stairs


def _is_default(point: Mapping[str, Any]) -> bool:
    return bool(point["setting"]["sweep"] == "default")


def _name(point: Mapping[str, Any]) -> str:
    """What is swept, as short as a label must be."""
    setting = point["setting"]
    sweep = setting["sweep"]
    if sweep == "default":
        return "default"
    value = setting["scale" if sweep == "resolution" else sweep]
    return f"1/{1 / value:g}" if 1e-4 < value < 1 and (1 / value).is_integer() else f"{value:.0e}" if value else "0"


def _words(point: Mapping[str, Any]) -> str:
    setting, ms, err = point["setting"], point["ms"], point["err"]
    what = SWEEPS.get(setting["sweep"], "")
    return (
        f"{what} {_name(point)}\n{ms['median']:.3g} ms, of which {ms['raster']:.3g} ms to rasterize\n"
        f"RMSE {err['rmse']:.2e}, largest {err['max']:.2e}, {err['lsb8_changed']:.2%} of 8-bit values changed"
    )


def _labels(points: Sequence[Mapping[str, Any]], places: Sequence[tuple[float, float]]) -> list[str]:
    """Names above and to the right of the marks, where no line of a sweep goes, pushed up until they are free."""
    taken = [(x - 4, x + 4, y + 4) for x, y in places]
    parts = []
    for i in sorted(range(len(points)), key=lambda i: -places[i][1]):
        x, y = places[i][0] + 6, places[i][1] - 5
        words = _name(points[i])
        end = x + 6.5 * len(words)
        while any(abs(y - other) < LABEL_HEIGHT and x < last and first < end for first, last, other in taken):
            y -= 2
        taken.append((x, end, y))
        parts.append(text(x, y, words, "small"))
    return parts
