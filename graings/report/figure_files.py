"""Figures as files, and the style that all figures share.

Imports matplotlib inside functions: it takes 0.4 s, which a command that draws nothing should not wait for.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PIXELS_PER_INCH: Final = 96  # of CSS: a figure of 960 pixels is 10 inches wide
PNG_SCALE: Final = 2  # pixels of the PNG for each of the figure

PAPER: Final = "#fcfcfb"
INK: Final = "#20252a"
NOTE: Final = "#5f666d"
GRID: Final = "#e4e5e3"
WARNING: Final = "#a33a12"

STYLE: Final[dict[Any, Any]] = {
    # Verdana has the letter widths of DejaVu Sans, which comes with matplotlib and gives the layout.
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Verdana"],
    "font.size": 8.5,
    "text.color": NOTE,
    "text.parse_math": False,  # names of runs may contain dollar signs
    "figure.facecolor": PAPER,
    "axes.facecolor": "none",
    "axes.edgecolor": "#9aa0a6",
    "axes.labelcolor": INK,
    "axes.labelpad": 8.0,
    "axes.spines.left": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "xtick.color": NOTE,
    "ytick.color": NOTE,
    "xtick.major.size": 0.0,
    "ytick.major.size": 0.0,
    "xtick.major.pad": 6.0,
    "ytick.major.pad": 6.0,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.5,
    "svg.fonttype": "none",  # text stays text: small files that can be searched
    "svg.hashsalt": "graings",  # the same numbers give the same bytes
}


@contextmanager
def style() -> Iterator[None]:
    """The common style, for everything that is drawn inside; also a decorator."""
    from matplotlib import rc_context

    with rc_context(STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # letters of a run's name that the font lacks
        yield


@style()
def svg(figure: Figure) -> str:
    """The SVG file of a figure. Equal figures have equal bytes."""
    file = io.StringIO()
    metadata = {"Title": figure.get_label(), "Creator": "GrainGS", "Date": None}
    figure.savefig(file, format="svg", metadata=metadata)
    return file.getvalue()


@style()
def png(figure: Figure) -> bytes:
    """The PNG file of a figure, at twice its size in pixels."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=PNG_SCALE * PIXELS_PER_INCH)
    return file.getvalue()
