from __future__ import annotations

import json
import math
import re
import stat
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from graings.config import make_config
from graings.errors import CheckpointError
from graings.report.machine import machine_facts, version_facts
from graings.report.report import config_hash, curve_svg, read_metrics, write_metrics, write_text

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


def test_a_document_comes_back_as_it_went(tmp_path: Path) -> None:
    document = {"schema": "graings.metrics/1", "splits": {}, "train_s": 1.5, "curve": [{"psnr": None}]}
    write_metrics(tmp_path / "metrics.json", document)
    assert read_metrics(tmp_path / "metrics.json") == document


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_json_cannot_say_is_refused_by_its_key_and_leaves_the_file_alone(tmp_path: Path, value: float) -> None:
    file = tmp_path / "metrics.json"
    write_metrics(file, {"train_s": 1.0})
    with pytest.raises(ValueError, match=re.escape("splits.val.views[1].psnr")):
        write_metrics(file, {"splits": {"val": {"views": [{"psnr": 1.0}, {"psnr": value}]}}})
    assert read_metrics(file) == {"train_s": 1.0}
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]


def test_a_failed_write_leaves_no_scrap(tmp_path: Path) -> None:
    (tmp_path / "occupied").mkdir()
    with pytest.raises(OSError, match="occupied"):
        write_text(tmp_path / "occupied", "text")
    assert [path.name for path in tmp_path.iterdir()] == ["occupied"]


def test_others_may_read_a_report(tmp_path: Path) -> None:
    write_text(tmp_path / "curve.svg", "<svg/>")
    assert stat.S_IMODE((tmp_path / "curve.svg").stat().st_mode) == 0o644


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"train_s": NaN}', '{"train_s": -Infinity}'])
def test_a_broken_document_is_named_with_a_remedy(tmp_path: Path, text: str) -> None:
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"metrics\.json.*Finish"):
        read_metrics(tmp_path / "metrics.json")


def test_the_hash_of_a_config_follows_its_values() -> None:
    draft = make_config("draft")
    assert config_hash(draft) == config_hash(make_config("draft"))
    assert config_hash(draft) != config_hash(make_config("draft", {"seed": 1}))


def test_facts_about_the_machine_are_strict_json() -> None:
    facts = {**machine_facts(3), **version_facts()}
    assert json.loads(json.dumps(facts, allow_nan=False))["threads"] == 3


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
