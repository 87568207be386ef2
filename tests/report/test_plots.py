"""The figures of runs: what they show of complete and of incomplete documents."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from itertools import pairwise
from typing import Any

import matplotlib
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from graings.report.axes import line_style, log_ticks, shortened
from graings.report.curve import curve_figure
from graings.report.figure_files import PNG_SCALE, WARNING, png, svg
from graings.report.formatting import count
from graings.report.render_plot import render_figure
from graings.report.training_plot import training_figure
from graings.report.work_precision import pareto
from tests.report.reports import part, point

SWEEP = (
    *(("default", 0.0, 10.0, 1e-3), ("resolution", 0.5, 6.0, 2e-2), ("resolution", 0.25, 4.0, 6e-2)),
    *(("alpha_min", 1 / 64, 9.0, 5e-3), ("alpha_min", 1e-6, 14.0, 1e-5), ("transmittance_min", 0.0, 15.0, 1e-3)),
)
LONG_NAME = "ablation/of-a-capture/with-a-long-name/standard/seed-0"
NO_POINTS = "no held-out view was evaluated"


def curve(*decibels: float | None, first: int = 50, factor: float = 1.5) -> list[dict[str, Any]]:
    places = [first * factor**i for i in range(len(decibels))]
    points = [point(0.1 * x, 0.0, iteration=round(x), gaussians=1000 + i).to_json() for i, x in enumerate(places)]
    return [{**values, "psnr": psnr} for values, psnr in zip(points, decibels, strict=True)]


def run(name: str, *decibels: float, pace: float = 1.0, **changes: Any) -> dict[str, Any]:
    points = [point(pace * 2.0**i, db, iteration=50 * 2**i, gaussians=1000 + 500 * i) for i, db in enumerate(decibels)]
    return part(name, *points, **changes).model_dump(mode="json")


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


def words(figure: Figure) -> list[str]:
    """All texts of the SVG file."""
    root = ElementTree.fromstring(svg(figure))
    return [element.text or "" for element in root.iter("{http://www.w3.org/2000/svg}text")]


def panels(figure: Figure) -> list[Axes]:
    """The axes with data; the first axes are the page around them."""
    return figure.axes[1:]


def line(axes: Axes, index: int) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in axes.lines[index].get_xydata()]


FIGURES = {
    "curve": lambda: curve_figure(curve(20.0, 25.0, 30.0)),
    "curve of nothing": lambda: curve_figure([]),
    "training": lambda: training_figure([run("a", 20.0, 25.0), run("b", 22.0)]),
    "training without a run": lambda: training_figure([]),
    "nine runs": lambda: training_figure([run(f"{LONG_NAME}{i}", 20.0 + i, 25.0 + i) for i in range(9)]),
    "render": lambda: render_figure([rendered("a", *SWEEP), rendered(LONG_NAME, *SWEEP)]),
    "render of one setting": lambda: render_figure([rendered("a", SWEEP[0])]),
    "render without a model": lambda: render_figure([]),
}


@pytest.mark.parametrize("name", FIGURES)
def test_equal_documents_give_equal_bytes_and_the_settings_of_matplotlib_stay(name: str) -> None:
    before = dict(matplotlib.rcParams)
    assert svg(FIGURES[name]()) == svg(FIGURES[name]())
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize(("name", "width"), [("curve", 960), ("nine runs", 1200), ("render", 1200)])
def test_a_png_has_twice_the_size_of_the_figure(name: str, width: int) -> None:
    file = png(FIGURES[name]())
    assert file.startswith(b"\x89PNG")
    assert int.from_bytes(file[16:20]) == PNG_SCALE * width


@pytest.mark.parametrize("count", [1, 2, 15, 80])
def test_a_curve_shows_every_evaluation_in_both_panels(count: int) -> None:
    points = curve(*(20.0 + 10.0 * math.log1p(i) for i in range(count)), factor=1.2)
    by_time, by_iteration = panels(curve_figure(points))
    assert line(by_time, 0) == [(p["train_s"], p["psnr"]) for p in points]
    assert line(by_iteration, 0) == [(p["iteration"], p["psnr"]) for p in points]
    for axes in (by_time, by_iteration):
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        assert all(left <= x <= right and low <= y <= high for x, y in line(axes, 0))


def test_a_curve_states_its_last_evaluation() -> None:
    texts = words(curve_figure(curve(20.0, 25.25)))
    assert texts.count("25.25 dB") == 2
    assert "25.25 dB after 7.5 s of training · 75 iterations · 1,001 Gaussians from 100 anchors" in texts


def test_psnr_and_rmse_are_written_at_the_same_height() -> None:
    axes = panels(curve_figure(curve(18.0, 22.0)))
    levels = [label.get_text() for label in axes[0].get_yticklabels()]
    errors = [text.get_text() for text in axes[-1].texts]
    assert errors[levels.index("20 dB")] == "0.100"


def test_evaluations_without_a_held_out_view_are_left_out() -> None:
    assert len(line(panels(curve_figure(curve(None, 25.0, 26.0)))[0], 0)) == 2
    assert NO_POINTS in words(curve_figure(curve(None)))
    assert NO_POINTS in words(curve_figure([]))


def test_an_evaluation_at_zero_seconds_is_at_the_start_of_the_axis() -> None:
    points = curve(20.0, 25.0)
    points[0]["train_s"] = 0.0
    axes = panels(curve_figure(points))[0]
    assert line(axes, 0)[0][0] == axes.get_xlim()[0]


@pytest.mark.parametrize("first", [9_500, 1, 100_000])
def test_a_short_axis_has_labels_too(first: int) -> None:
    for axes in panels(curve_figure(curve(30.0, 30.1, first=first, factor=1.01))):
        assert len(axes.get_xticklabels()) >= (1 if first == 1 else 2)


def test_labels_of_an_axis_have_room() -> None:
    ticks = sorted(log_ticks([1.0, 1000.0], 400, (1, 10, 11, 100, 1000), room=40))
    assert ticks == [1, 10, 100, 1000]


@pytest.mark.parametrize("count", [1, 2, 9])
def test_every_run_has_a_line_of_its_own_in_each_panel_and_a_row(count: int) -> None:
    figure = training_figure([run(f"run-{i}", 20.0 + i, 25.0, 30.0) for i in range(count)])
    for axes in panels(figure):
        lines = [shape for shape in axes.lines if len(shape.get_xdata()) == 3]
        styles = {(to_hex(shape.get_color()), shape.get_marker(), shape.get_linestyle()) for shape in lines}
        assert len(lines) == len(styles) == count
    assert [name for name in words(figure) if name.startswith("run-")] == [f"run-{i}" for i in range(count)]


def test_the_first_56_lines_differ() -> None:
    assert len({str(line_style(index)) for index in range(56)}) == 56


def test_panels_have_the_same_quality_axis_and_runs_the_same_time_axis() -> None:
    axes = panels(training_figure([run("slow", 20.0, 30.0, pace=4.0), run("fast", 20.0, 30.0)]))
    assert len({panel.get_ylim() for panel in axes}) == 1
    assert line(axes[0], 0) == [(4.0, 20.0), (8.0, 30.0)]
    assert line(axes[0], 2) == [(1.0, 20.0), (2.0, 30.0)]


def test_a_time_to_a_target_is_a_number_or_a_limit() -> None:
    texts = words(training_figure([run("a", 22.0, 27.0)]))
    assert "≤ 1 s" in texts  # 20 dB, at the first evaluation
    assert "1.52 s" in texts  # 25 dB: 2 to the power 3/5
    assert texts.count("> 2 s") == 3


def test_the_wall_clock_time_is_shown_by_phase() -> None:
    figure = training_figure([run("a", 22.0, 27.0, wall_s=100.0, train_cpu_s=150.0)])
    train, evaluation, _, other = (bar.get_width() for bar in figure.axes[0].patches)
    assert evaluation / train == pytest.approx(12 / 80)
    assert other / train == pytest.approx(1 / 80)
    assert {"train 1.33 min · evaluation 12 s", "CPU time of training 2.5 min"} <= set(words(figure))


def test_phases_that_do_not_add_up_are_a_warning() -> None:
    def warnings(figure: Figure) -> list[str]:
        return [text.get_text() for text in figure.axes[0].texts if text.get_color() == WARNING]

    assert warnings(training_figure([run("a", 22.0)])) == []
    assert warnings(training_figure([run("a", 22.0, wall_s=200.0)])) == [
        "the phases do not add up",
        "a: phases sum to 100 s, the total is 200 s: 50.0% apart",
    ]


def test_runs_without_an_evaluation_have_a_row_and_no_line() -> None:
    assert NO_POINTS in words(training_figure([run("a")]))
    both = training_figure([run("a"), run("b", 20.0, 25.0)])
    assert [len(shape.get_xdata()) for shape in panels(both)[0].lines if len(shape.get_xdata()) > 1] == [2]
    assert {"a", "b"} <= set(words(both))


@pytest.mark.parametrize("name", ['<&">', "$x_1$", "\N{CJK UNIFIED IDEOGRAPH-5834}\\frac"])
def test_a_name_is_written_as_it_is(name: str) -> None:
    assert name in words(training_figure([run(name, 20.0)]))
    assert name in words(render_figure([rendered(name, *SWEEP)]))


def test_of_a_long_name_the_end_is_shown() -> None:
    assert shortened("abcdef", 6) == "abcdef"
    assert shortened("abcdefg", 6) == "…cdefg"
    assert any(text.startswith("…") and text.endswith("seed-0") for text in words(training_figure([run(LONG_NAME)])))


def test_each_model_has_a_panel_with_a_line_for_each_sweep_and_a_label_for_each_setting() -> None:
    figure = render_figure([rendered("a", *SWEEP), rendered("b", *SWEEP)])
    assert len(panels(figure)) == 2
    for axes in panels(figure):
        resolution, alpha, transmittance, _, default = (line(axes, index) for index in range(5))
        assert resolution == [(4.0, 6e-2), (6.0, 2e-2), (10.0, 1e-3)]
        assert alpha == [(14.0, 1e-5), (10.0, 1e-3), (9.0, 5e-3)]
        assert transmittance == [(15.0, 1e-3), (10.0, 1e-3)]
        assert default == [(10.0, 1e-3)]
    assert {"default", "1/2", "1/4", "1/64", "1e-06", "0", "40 dB", "0.010", "Pareto front"} <= set(words(figure))


def test_the_pareto_front_goes_through_the_best_settings_in_steps() -> None:
    front = panels(render_figure([rendered("a", *SWEEP)]))[0].lines[3]
    assert front.get_drawstyle() == "steps-post"
    assert [float(x) for x in front.get_xdata()] == [4.0, 6.0, 9.0, 10.0, 14.0]  # 15 ms is no better than the default


def test_an_error_of_zero_is_at_the_bottom() -> None:
    axes = panels(render_figure([rendered("a", SWEEP[0], ("alpha_min", 0.0, 20.0, 0.0))]))[0]
    assert line(axes, 1)[0][1] == axes.get_ylim()[0]


def test_labels_of_equal_settings_do_not_cover_each_other() -> None:
    equal = (("alpha_min", 1 / 512, 10.0, 1e-3), ("alpha_min", 1 / 128, 10.0, 1e-3))
    labels = {"default", "1/512", "1/128"}
    page = render_figure([rendered("a", *SWEEP, *equal)]).axes[0]
    heights = sorted(text.get_position()[1] for text in page.texts if text.get_text() in labels)
    assert len(heights) == 3
    assert min(after - before for before, after in pairwise(heights)) >= 12


@pytest.mark.parametrize(
    ("number", "text"), [(0, "0"), (999, "999"), (1000, "1k"), (41_500, "41.5k"), (2.56e6, "2.56M")]
)
def test_a_count_is_written_in_thousands_or_millions(number: float, text: str) -> None:
    assert count(number) == text
