"""The figure of an ablation, of complete and of incomplete tables."""

from __future__ import annotations

import statistics
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from typing import Any

import pytest
from matplotlib.figure import Figure

from graings.ablation.plot import differences_figure
from graings.ablation.rows import FULL, ROWS, Row
from graings.report.figure_files import PNG_SCALE, png, svg

MINUS = "\N{MINUS SIGN}"


def table(differences: Mapping[str, Sequence[float | None]], full: float | None, rows: Sequence[Row] = ROWS) -> Any:
    """What the figure reads of a table: differences by row and seed, None where a run is not finished."""
    seeds = max(map(len, differences.values()), default=1)
    return {
        "capture": {"name": "tiny", "views": 20, "width": 40, "height": 30},
        **{"options": {"iterations": 1100}, "seeds": list(range(seeds))},
        "rows": [row_of(row, differences.get(row.name, [None] * seeds), full) for row in rows],
    }


def row_of(row: Row, differences: Sequence[float | None], full: float | None) -> dict[str, Any]:
    known = [value for value in differences if value is not None]
    mean = statistics.fmean(known) if known else None
    return {
        **{"name": row.name, "label": row.label, "runs": [{"difference": value} for value in differences]},
        **{"difference": {"mean": mean}, "psnr": {"mean": None if full is None or mean is None else full + mean}},
        "paper": None if row.paper is None else {"difference": row.paper.difference},
    }


def words(figure: Figure) -> list[str]:
    root = ElementTree.fromstring(svg(figure))
    return [element.text or "" for element in root.iter("{http://www.w3.org/2000/svg}text")]


def test_a_row_shows_its_seeds_their_mean_and_the_papers_difference() -> None:
    figure = differences_figure(table({FULL: (0.0, 0.0), "no_residual": (-0.5, -1.0)}, full=30.5))
    _, seeds, means, papers = figure.axes[1].lines
    assert list(seeds.get_xdata()) == [-0.5, -1.0]
    assert len(set(seeds.get_ydata())) == 2
    assert list(means.get_xdata()) == [-0.75]
    assert sorted(papers.get_xdata()) == sorted(row.paper.difference for row in ROWS if row.paper and row.name != FULL)
    summary = "full 30.50 dB on 20 validation views · 40 x 30 · 1,100 iterations · 2 seeds"
    assert {f"{MINUS}0.75 dB", summary} < set(words(figure))
    labels = [label.get_text() for label in figure.axes[1].get_yticklabels()]
    assert labels == [row.label for row in ROWS if row.name != FULL]


def test_a_table_without_a_finished_run_names_its_rows() -> None:
    texts = words(differences_figure(table({}, full=None)))
    assert texts.count("not measured yet") == len(ROWS) - 1
    assert {row.label for row in ROWS if row.name != FULL} < set(texts)


@pytest.mark.parametrize(("rows", "values"), [((), (0.0,)), (ROWS[:1], (None,)), (ROWS[:2], (0.0, None, 0.0))])
def test_few_rows_and_equal_numbers_make_a_figure_too(rows: Sequence[Row], values: Sequence[float | None]) -> None:
    document = table({row.name: values for row in rows}, 30.0, rows)
    assert svg(differences_figure(document)) == svg(differences_figure(document))
    assert int.from_bytes(png(differences_figure(document))[16:20]) == PNG_SCALE * 960
