from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from graings.report.picture import png
from graings.report.plots import COLOURS, training_svg
from graings.report.render_plot import render_svg
from graings.report.work_precision import pareto
from tests.report.reports import elements, part, point, words


def run(name: str, *decibels: float, pace: float = 1.0, **changes: Any) -> dict[str, Any]:
    curve = [point(pace * 2.0**i, db, iteration=50 * 2**i, gaussians=1000 + 500 * i) for i, db in enumerate(decibels)]
    return part(name, *curve, **changes).model_dump(mode="json")


def rendered(name: str, *points: tuple[str, float, float, float]) -> dict[str, Any]:
    """A part of kind render from (sweep, value, milliseconds, error)."""
    made = []
    for sweep, value, ms, rmse in points:
        setting = {"sweep": sweep, "scale": 1.0, "alpha_min": 1 / 255, "transmittance_min": 1e-4}
        if sweep != "default":
            setting["scale" if sweep == "resolution" else sweep] = value
        times = {"median": ms, "min": ms, "iqr": 0.0, "networks": 1.0, "raster": ms - 1.0}
        made.append({"setting": setting, "ms": times, "err": {"rmse": rmse, "max": rmse, "lsb8_changed": 0.1}})
    return {
        **{"run": {"name": name}, "views": {"split": "val", "names": ["a", "b"]}, "size": {"width": 40, "height": 30}},
        **{"machine": {"threads": 1}, "noisy": False, "points": made},
        "pareto": pareto([p[2] for p in points], [p[3] for p in points]),
    }


SWEEP = (
    *(("default", 0.0, 10.0, 1e-3), ("resolution", 0.5, 6.0, 2e-2), ("resolution", 0.25, 4.0, 6e-2)),
    *(("alpha_min", 1 / 64, 9.0, 5e-3), ("alpha_min", 1e-6, 14.0, 1e-5), ("transmittance_min", 0.0, 15.0, 1e-3)),
)


@pytest.mark.parametrize("count", [1, 2, len(COLOURS) + 1])
def test_every_run_has_one_line_in_each_of_three_panels_and_a_row(count: int) -> None:
    svg = training_svg([run(f"run-{i}", 20.0 + i, 25.0, 30.0) for i in range(count)])
    lines = elements(svg, "polyline")
    assert len(lines) == 3 * count
    assert len({line.attrib["class"] for line in lines}) == count
    assert len(elements(svg, "circle")) == 3 * 3 * count
    assert [name for name in words(svg) if name.startswith("run-")] == [f"run-{i}" for i in range(count)]


def test_runs_share_their_axes() -> None:
    svg = training_svg([run("slow", 20.0, 30.0, pace=4.0), run("fast", 20.0, 30.0)])
    slow, fast = (
        [tuple(map(float, pair.split(","))) for pair in line.attrib["points"].split()]
        for line in elements(svg, "polyline")[:2]
    )
    assert [y for _, y in slow] == [y for _, y in fast]
    assert slow[0][0] > fast[1][0]  # its first evaluation came after the last of the other
    assert slow[1][1] < slow[0][1]  # better is higher


def test_times_are_told_from_limits() -> None:
    svg = training_svg([run("a", 22.0, 27.0)])
    texts = words(svg)
    assert "≤ 1 s" in texts  # 20 dB, had at the first evaluation
    assert "1.52 s" in texts  # 25 dB: 2 to the power 3/5
    assert texts.count("> 2 s") == 3


def test_evaluation_and_checkpoints_are_shown_apart_from_training() -> None:
    svg = training_svg([run("a", 22.0, 27.0, wall_s=100.0)])
    widths = {kind: float(elements(svg, "rect", kind)[0].attrib["width"]) for kind in ("train", "evaluation", "other")}
    assert widths["evaluation"] / widths["train"] == pytest.approx(12 / 80, rel=0.01)
    assert widths["other"] / widths["train"] == pytest.approx(1 / 80, rel=0.1)
    assert any("evaluation 12 s" in text for text in words(svg))


def test_phases_that_do_not_add_up_are_said_in_the_picture() -> None:
    assert elements(training_svg([run("a", 22.0)]), "text", "warning") == []
    warned = elements(training_svg([run("a", 22.0, wall_s=200.0)]), "text", "warning")
    assert any("phases sum to 100 s, the total is 200 s" in (text.text or "") for text in warned)


def test_runs_without_an_evaluation_make_a_picture_too() -> None:
    assert "no held-out view was evaluated" in words(training_svg([run("a")]))
    both = training_svg([run("a"), run("b", 20.0, 25.0)])
    assert len(elements(both, "polyline")) == 3


def test_names_cannot_break_the_picture() -> None:
    assert '<&">' in words(training_svg([run('<&">', 20.0)]))


def test_a_panel_for_each_model_with_a_mark_for_each_setting() -> None:
    svg = render_svg([rendered("a", *SWEEP), rendered("b", *SWEEP)])
    assert len(elements(svg, "polyline", "curve")) == 2 * 3
    assert len(elements(svg, "polyline", "front")) == 2
    assert len(elements(svg, "circle")) == 2 * len(SWEEP) + 1  # and one in the legend
    assert {"default", "1/2", "1/4", "1/64", "1e-06", "0", "40 dB", "0.010"} <= set(words(svg))


def test_the_front_passes_the_best_marks_in_steps() -> None:
    svg = render_svg([rendered("a", *SWEEP)])
    stairs = [tuple(map(float, p.split(","))) for p in elements(svg, "polyline", "front")[0].attrib["points"].split()]
    assert len(stairs) == 2 * 5 - 1  # all but the slowest setting, which is no better than the default
    assert all(before[0] == after[0] or before[1] == after[1] for before, after in pairwise(stairs))


def test_labels_of_equal_settings_do_not_cover_one_another() -> None:
    svg = render_svg([rendered("a", *SWEEP, ("alpha_min", 1 / 512, 10.0, 1e-3), ("alpha_min", 1 / 128, 10.0, 1e-3))])
    places = sorted(float(text.attrib["y"]) for text in elements(svg, "text", "small") if text.text != "0")
    assert min(after - before for before, after in pairwise(places)) >= 12


def test_a_picture_is_the_drawing_at_twice_its_size() -> None:
    pytest.importorskip("matplotlib", reason="PNG needs the extra plot")
    file = png(training_svg([run("a $x$", 20.0, 25.0), *(run(f"b{i}", 20.0) for i in range(8))]))
    assert file.startswith(b"\x89PNG")
    assert int.from_bytes(file[16:20]) == 2 * 1200
