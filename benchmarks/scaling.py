"""How a cost grows with a size: its slope in logarithms, printed and drawn, for the scaling benchmarks.

python benchmarks/scaling.py FILE.json        draws a document of those benchmarks again, as FILE.svg
"""

from __future__ import annotations

import json
import math
import statistics
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from graings.report.axes import line_style
from graings.report.figure_files import INK, style, svg
from graings.report.formatting import count

# Milliseconds by part, by size (as text), by what the size is.
Series = Mapping[str, Mapping[str, Mapping[str, float]]]


def slope(points: list[tuple[float, float]]) -> float:
    """Least squares through log-log points: 1 is linear, 0 does not grow."""
    xs, ys = [math.log(x) for x, _ in points], [math.log(max(y, 1e-6)) for _, y in points]
    mx, my = statistics.fmean(xs), statistics.fmean(ys)
    return sum((x - mx) * (y - my) for x, y in zip(xs, ys, strict=True)) / sum((x - mx) ** 2 for x in xs)


def lines(rows: Mapping[str, Mapping[str, float]]) -> dict[str, list[tuple[float, float]]]:
    """(size, milliseconds) of each part and of their sum, by size."""
    sizes = sorted(rows, key=int)
    parts = {name: [(float(size), rows[size][name]) for size in sizes] for name in rows[sizes[0]]}
    return parts | {"all": [(float(size), sum(rows[size].values())) for size in sizes]}


def print_slopes(series: Series) -> None:
    """A line for each part: its milliseconds by size, and their slope."""
    for title, rows in series.items():
        print(f"\nagainst {title}: " + ", ".join(f"{int(size):,d}" for size in sorted(rows, key=int)))
        for name, points in lines(rows).items():
            numbers = "  ".join(f"{y:8.2f}" for _, y in points)
            print(f"  {name:<50} {numbers}   slope {slope(points):5.2f}")


@style()
def scaling_figure(document: Mapping[str, Any]) -> Figure:
    """A panel for each of the document's `series`, a line for each part."""
    series: Series = document["series"]
    figure = Figure((5 * len(series), 5.4), layout="constrained")
    figure.suptitle(f"{document['title']} ({document['isa']}, {document['threads']} threads)", color=INK, fontsize=12)
    for axes, (title, rows) in zip(figure.subplots(1, len(series), sharey=True), series.items(), strict=True):
        for index, (name, points) in enumerate(lines(rows).items()):
            label = f"{name.split(' (')[0]} ({slope(points):.2f})"
            total = {"color": INK, "linewidth": 2.6, "linestyle": "-", "marker": ""} if name == "all" else {}
            axes.loglog(*zip(*points, strict=True), label=label, **{**line_style(index), **total})
        axes.set_xlabel(title)
        sizes = sorted(map(int, rows))
        axes.set_xticks(sizes, [count(size) for size in sizes])
        axes.minorticks_off()
        axes.yaxis.set_major_formatter("{x:g}")
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "ncols": 2}  # lines fill the whole panel
        axes.legend(title="part (slope)", fontsize=7.5, title_fontsize=7.5, **below)
    figure.axes[0].set_ylabel("milliseconds")
    return figure


def write_scaling(folder: Path, name: str, document: Mapping[str, Any]) -> None:
    """Print the slopes of the document and write it as `name`.json and .svg."""
    print_slopes(document["series"])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
    (folder / f"{name}.svg").write_text(svg(scaling_figure(document)))


if __name__ == "__main__":
    file = Path(sys.argv[1])
    file.with_suffix(".svg").write_text(svg(scaling_figure(json.loads(file.read_text()))))
