"""Curve: held-out error of one run against training time and iterations, as a drawing.

One line serves two axes: on the left the error, on the right the same number in decibels (PSNR = -20 log10 RMSE).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from graings.report.drawing import COUNTS, SECONDS, DecibelAxis, LogAxis, line, mark, panel, svg, text
from graings.report.formatting import count, duration

WIDTH: Final = 960
HEIGHT: Final = 400
LEFT, RIGHT, TOP, BOTTOM = 66.0, 902.0, 96.0, 336.0
GUTTER: Final = 40.0  # between the two panels
PANEL: Final = (RIGHT - LEFT - GUTTER) / 2


def curve_svg(points: Sequence[Mapping[str, Any]]) -> str:
    """Draw `points`: mappings with iteration, train_s, psnr, rmse, ssim_3dgs, gaussians and anchors, in order.

    Any number of points makes a picture, also none; those without a PSNR are left out.
    """
    drawn = [point for point in points if point["psnr"] is not None]
    body = _plot(drawn) if drawn else [text(WIDTH / 2, HEIGHT / 2, "no held-out view was evaluated", anchor="middle")]
    title = "Held-out error against run time"
    return svg(WIDTH, HEIGHT, title, [text(LEFT, 36, title, "title"), *body])


def _plot(points: Sequence[Mapping[str, Any]]) -> list[str]:
    decibels = [float(point["psnr"]) for point in points]
    quality = DecibelAxis.over(decibels, TOP, BOTTOM)
    last = points[-1]
    summary = (
        f"{last['psnr']:.2f} dB after {duration(last['train_s'])} of training · {last['iteration']:,} iterations · "
        f"{last['gaussians']:,} Gaussians from {last['anchors']:,} anchors"
    )
    parts = [text(LEFT, 58, summary), *quality.names(LEFT - 10, RIGHT + 10)]
    panels: tuple[tuple[str, str, Sequence[float], Callable[[float], str]], ...] = (
        ("train_s", "training time", SECONDS, duration),
        ("iteration", "iterations", COUNTS, count),
    )
    for index, (key, label, welcome, name) in enumerate(panels):
        left = LEFT + index * (PANEL + GUTTER)
        values = [float(point[key]) for point in points]
        axis = LogAxis.over(values, left, PANEL)
        parts += panel(axis, quality, label, welcome, name)
        places = [(axis.at(value), quality.at(level)) for value, level in zip(values, decibels, strict=True)]
        parts.append(line(places))
        parts += [
            mark(place, point_words(point), "point last" if point is last else "point")
            for place, point in zip(places, points, strict=True)
        ]
        x, y = places[-1]
        parts.append(text(x + 4, y - 13, f"{last['psnr']:.2f} dB", "value", "end"))
    return parts


def point_words(point: Mapping[str, Any]) -> str:
    """What one evaluation says when the pointer rests on it."""
    return (
        f"{point['psnr']:.2f} dB, RMSE {point['rmse']:.4f}, SSIM {point['ssim_3dgs']:.4f}\n"
        f"{duration(point['train_s'])}, iteration {point['iteration']:,}\n{point['gaussians']:,} Gaussians"
    )
