"""Drawing: the pieces of a handwritten SVG: a page with its look, lines of text and rules.

Without dependencies, and following the reader's light or dark theme. Coordinates are pixels, x to the right and y
down. Knows nothing of what is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Final

# Colours are spelled out per theme: not every reader of SVG knows custom properties.
STYLE: Final = """
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
@media (prefers-color-scheme: dark) {
  text { fill: #9aa2aa; }
  .title, .label { fill: #e8eaec; }
  .value { fill: #62c6da; }
  .paper { fill: #16191c; }
  .grid { stroke: #2a2e33; }
  .axis { stroke: #5b636b; }
  .curve, .point { stroke: #62c6da; }
  .point { fill: #16191c; }
  .last { fill: #62c6da; }
}
"""


def page(title: str, width: int, height: int, parts: Sequence[str], style: str = "") -> str:
    """A whole SVG document of `parts`; `style` adds rules to the common ones."""
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
            f'height="{height}" role="img" aria-label="{escape(title)}">',
            f"<style>{STYLE}{style}</style>",
            f'<rect class="paper" width="{width}" height="{height}" rx="8"/>',
            *parts,
            "</svg>\n",
        ]
    )


def text(x: float, y: float, words: str, kind: str = "note", anchor: str = "start") -> str:
    """One line of text with its baseline at `y`; `anchor` is start, middle or end."""
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>'


def rule(x1: float, y1: float, x2: float, y2: float, kind: str = "grid") -> str:
    """A straight line."""
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'
