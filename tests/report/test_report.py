from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree

import pytest

from graings.report.report import curve_svg

SVG = "{http://www.w3.org/2000/svg}"


def points(*decibels: float | None, first: int = 50, factor: float = 1.5) -> list[dict[str, float | None]]:
    return [
        {
            "iteration": round(first * factor**i),
            "train_s": 0.1 * first * factor**i,
            "psnr": db,
            "rmse": 10.0 ** (-(db or 0.0) / 20.0),
            "ssim_3dgs": 0.9,
            "gaussians": 1000 + i,
            "anchors": 100 + i,
        }
        for i, db in enumerate(decibels)
    ]


def circles(svg: str) -> list[ElementTree.Element]:
    return list(ElementTree.fromstring(svg).iter(f"{SVG}circle"))


def words(svg: str) -> list[str]:
    return [element.text or "" for element in ElementTree.fromstring(svg).iter(f"{SVG}text")]


@pytest.mark.parametrize("count", [1, 2, 3, 15, 80])
def test_the_drawing_has_a_mark_per_point_and_panel_inside_its_frame(count: int) -> None:
    svg = curve_svg(points(*(20.0 + 10.0 * math.log1p(i) for i in range(count)), factor=1.2))
    marks = circles(svg)
    assert len(marks) == 2 * count
    assert all(66 <= float(mark.attrib["cx"]) <= 902 and 96 <= float(mark.attrib["cy"]) <= 336 for mark in marks)


def test_better_is_higher_and_later_is_further_right() -> None:
    worse, better = circles(curve_svg(points(25.0, 31.0)))[:2]
    assert float(better.attrib["cy"]) < float(worse.attrib["cy"])
    assert float(better.attrib["cx"]) > float(worse.attrib["cx"])


def test_equal_ratios_of_time_are_equal_distances() -> None:
    x = [float(mark.attrib["cx"]) for mark in circles(curve_svg(points(25.0, 26.0, 27.0)))[:3]]
    assert math.isclose(x[1] - x[0], x[2] - x[1], abs_tol=0.11)  # written with one decimal


def test_both_axes_name_the_same_height() -> None:
    labels = words(curve_svg(points(18.0, 22.0)))
    assert labels.index("0.100") + 1 == labels.index("20 dB")


def test_points_without_a_held_out_view_are_left_out() -> None:
    assert len(circles(curve_svg(points(None, 25.0, 26.0)))) == 4


def test_a_run_without_evaluation_says_so() -> None:
    assert "no held-out view was evaluated" in words(curve_svg([]))


@pytest.mark.parametrize("first", [9_500, 1, 100_000])
def test_every_axis_carries_labels_also_over_a_short_range(first: int) -> None:
    svg = curve_svg(points(30.0, 30.1, first=first, factor=1.01))
    centred = [e for e in ElementTree.fromstring(svg).iter(f"{SVG}text") if e.attrib["text-anchor"] == "middle"]
    assert len(centred) >= 2 * 2 + 2  # two numbers per axis and its name


def test_a_point_at_zero_seconds_sits_at_the_start_of_the_axis() -> None:
    curve = points(20.0, 25.0)
    curve[0]["train_s"] = 0.0
    assert float(circles(curve_svg(curve))[0].attrib["cx"]) == 66.0
