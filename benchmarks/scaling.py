"""Scaling plots: the slope of log cost against log size, printed and plotted; used by the scaling benchmarks."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from typing import Any


def slope(points: list[tuple[float, float]]) -> float:
    """Least squares through log-log points: 1 is linear, 0 is constant."""
    xs, ys = [math.log(x) for x, _ in points], [math.log(max(y, 1e-6)) for _, y in points]
    mx, my = statistics.fmean(xs), statistics.fmean(ys)
    return sum((x - mx) * (y - my) for x, y in zip(xs, ys, strict=True)) / sum((x - mx) ** 2 for x in xs)


def show(axis: Any, title: str, rows: Mapping[int, Mapping[str, float]], parts: str) -> None:
    """Print and draw milliseconds by size and part, and their sum; `parts` is the title of the legend."""
    sizes = sorted(rows)
    print(f"\nagainst {title}: " + ", ".join(f"{size:,d}" for size in sizes))
    lines = {name: [(float(size), rows[size][name]) for size in sizes] for name in rows[sizes[0]]}
    lines["all"] = [(float(size), sum(rows[size].values())) for size in sizes]
    for name, points in lines.items():
        numbers = "  ".join(f"{y:8.2f}" for _, y in points)
        print(f"  {name:<50} {numbers}   slope {slope(points):5.2f}")
        style = {"color": "black", "linewidth": 2.2} if name == "all" else {}
        label = f"{name.split(' (')[0]} ({slope(points):.2f})"
        axis.loglog(*zip(*points, strict=True), marker="o", markersize=3, label=label, **style)
    axis.set_xlabel(title)
    axis.grid(True, which="major", color="0.9")
    below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.14), "ncols": 3}  # below the axes, which the lines fill
    axis.legend(fontsize=8, frameon=False, title=f"{parts} (slope)", title_fontsize=8, **below)
