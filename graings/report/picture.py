"""Picture: one of our drawings as PNG.

Draws the few elements of SVG that `graings.report.drawing` writes, with the light half of their style sheet, through
matplotlib, which is an optional extra. Knows nothing of what is drawn.
"""

from __future__ import annotations

import io
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from typing import Any, Final, Literal

SCALE: Final = 2.0  # pixels of the picture for each of the drawing
DOTS: Final = 100  # pixels of the drawing per inch; any number would do, matplotlib wants one
EXTRA: Final = "plot"

_PLACES: Final = ("x", "y", "x1", "y1", "x2", "y2", "cx", "cy", "r", "width", "height")
_ANCHORS: Final[Mapping[str, Literal["left", "center", "right"]]] = {
    "start": "left",
    "middle": "center",
    "end": "right",
}
_RULE: Final = re.compile(r"([^{}]+)\{([^{}]*)\}")
_NAMESPACE: Final = "{http://www.w3.org/2000/svg}"


def missing_reason() -> str | None:
    """What to install before a PNG can be made, or None."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return f"matplotlib is not installed (pip install 'graings[{EXTRA}]')"
    return None


def png(drawing: str) -> bytes:
    """The PNG file of an SVG text, twice its size. Raises `ImportError` without matplotlib; see `missing_reason`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    root = ElementTree.fromstring(drawing)
    rules = _light_rules(next(root.iter(f"{_NAMESPACE}style")).text or "")
    width, height = float(root.attrib["width"]), float(root.attrib["height"])
    figure = Figure(figsize=(width / DOTS, height / DOTS), dpi=DOTS * SCALE)
    FigureCanvasAgg(figure)
    # One unit of the axes is one pixel of the drawing, and later elements lie above earlier ones, as in SVG.
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
    axes.axis("off")
    for order, element in enumerate(root):
        tag = element.tag.removeprefix(_NAMESPACE)
        if tag != "style":
            artist = _artist(element, tag, _style(rules, tag, element.attrib.get("class", "")))
            artist.set_zorder(order)
            axes.add_artist(artist)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def _artist(element: ElementTree.Element, tag: str, style: Mapping[str, str]) -> Any:
    """What matplotlib draws for one element."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle, Polygon, Rectangle
    from matplotlib.text import Text

    place = {key: float(value) for key, value in element.attrib.items() if key in _PLACES}
    stroke = {"linewidth": _points(style, "stroke-width", 1.0), "linestyle": _dashes(style)}
    if tag == "line":
        ends = ([place["x1"], place["x2"]], [place["y1"], place["y2"]])
        return Line2D(*ends, color=style["stroke"], **stroke)
    if tag == "polyline":
        corners = [pair.split(",") for pair in element.attrib["points"].split()]
        across, down = [float(x) for x, _ in corners], [float(y) for _, y in corners]
        return Line2D(across, down, color=style["stroke"], solid_joinstyle="round", **stroke)
    if tag == "circle":
        return Circle((place["cx"], place["cy"]), place["r"], linewidth=stroke["linewidth"], **_inks(style))
    if tag == "polygon":
        outline = [tuple(map(float, pair.split(","))) for pair in element.attrib["points"].split()]
        return Polygon(outline, linewidth=stroke["linewidth"], **_inks(style))
    if tag == "rect":
        corner = (place.get("x", 0.0), place.get("y", 0.0))
        return Rectangle(corner, place["width"], place["height"], facecolor=style["fill"], linewidth=0)
    if tag == "text":
        return Text(
            place["x"],
            place["y"],
            (element.text or "").replace("$", r"\$"),
            color=style["fill"],
            fontsize=_points(style, "font-size", 12.0),
            fontweight="bold" if style.get("font-weight") == "600" else "normal",  # few fonts have a weight between
            horizontalalignment=_ANCHORS[element.attrib["text-anchor"]],
            verticalalignment="baseline",
        )
    raise ValueError(f"no drawing of ours contains <{tag}>")


def _inks(style: Mapping[str, str]) -> dict[str, Any]:
    """Inside and outline of an area."""
    fill = (style["fill"], float(style.get("fill-opacity", 1)))
    return {"facecolor": fill, "edgecolor": style.get("stroke", "none")}


def _light_rules(sheet: str) -> list[tuple[str, dict[str, str]]]:
    """Selectors and their properties in the order of the sheet, without those of the dark theme."""
    rules = []
    for selectors, body in _RULE.findall(sheet.partition("@media")[0]):
        properties = dict(part.split(":", 1) for part in body.split(";") if ":" in part)
        cleaned = {key.strip(): value.strip() for key, value in properties.items()}
        rules += [(selector.strip(), cleaned) for selector in selectors.split(",")]
    return rules


def _style(rules: list[tuple[str, dict[str, str]]], tag: str, classes: str) -> dict[str, str]:
    """Properties of an element: a class weighs more than a tag, a later rule more than an earlier one."""
    mine = [tag, *(f".{name}" for name in classes.split())]
    style: dict[str, str] = {}
    for selector, properties in sorted(rules, key=lambda rule: rule[0].startswith(".")):
        if selector in mine:
            style |= properties
    return style


def _points(style: Mapping[str, str], key: str, default: float) -> float:
    """A length of the style sheet, which is in pixels, in the points that matplotlib counts."""
    return float(style[key].removesuffix("px") if key in style else default) * 72 / DOTS


def _dashes(style: Mapping[str, str]) -> Any:
    dashes = style.get("stroke-dasharray")
    return (0, tuple(float(length) / 2 for length in dashes.split())) if dashes else "solid"
