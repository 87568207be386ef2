"""The figure of an ablation, of complete and of incomplete tables."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from typing import Any

import pytest
from matplotlib.figure import Figure

from graings.ablation.plot import differences_figure
from graings.ablation.rows import FULL, ROWS, Row
from graings.ablation.table import document
from graings.report.figure_files import PNG_SCALE, png, svg

MINUS = "\N{MINUS SIGN}"


def table(psnr: dict[str, Sequence[float | None]], rows: Sequence[Row] = ROWS) -> dict[str, Any]:
    """A table of runs without training: PSNR by row and seed, None where a run is not finished."""
    seeds = range(max(map(len, psnr.values()), default=1))
    facts = {
        "capture": {"name": "tiny", "hash": "h", "views": 20, "width": 40, "height": 30},
        **{"options": {"preset": "draft", "iterations": 1100}, "changed_options": {}, "seeds": list(seeds)},
    }
    return document(facts, [(row, dict(enumerate(map(metrics, psnr.get(row.name, (None,)))))) for row in rows])


def metrics(psnr: float | None) -> dict[str, Any] | None:
    if psnr is None:
        return None
    return {
        **{"splits": {"val": {"psnr": psnr, "ssim_3dgs": 0.9}}, "gaussians": 1000, "anchors": 100, "train_s": 60.0},
        **{"versions": {"commit": "c"}, "machine": {"cpu": "m"}},
    }


def words(figure: Figure) -> list[str]:
    root = ElementTree.fromstring(svg(figure))
    return [element.text or "" for element in root.iter("{http://www.w3.org/2000/svg}text")]


def test_a_row_shows_its_seeds_their_mean_and_the_papers_difference() -> None:
    figure = differences_figure(table({FULL: (30.0, 31.0), "no_residual": (29.5, 30.0)}))
    _, seeds, means, papers = figure.axes[1].lines
    assert list(seeds.get_xdata()) == pytest.approx([-0.5, -1.0])
    assert len(set(seeds.get_ydata())) == 2
    assert list(means.get_xdata()) == pytest.approx([-0.75])
    assert sorted(papers.get_xdata()) == sorted(row.paper.difference for row in ROWS if row.paper and row.name != FULL)
    summary = "full 30.50 dB on 20 validation views · 40 x 30 · 1,100 iterations · 2 seeds"
    assert {f"{MINUS}0.75 dB", summary} < set(words(figure))
    labels = [label.get_text() for label in figure.axes[1].get_yticklabels()]
    assert labels == [row.label for row in ROWS if row.name != FULL]


def test_a_table_without_a_finished_run_names_its_rows() -> None:
    texts = words(differences_figure(table({})))
    assert texts.count("not measured yet") == len(ROWS) - 1
    assert {row.label for row in ROWS if row.name != FULL} < set(texts)


@pytest.mark.parametrize(("rows", "psnr"), [((), (30.0,)), (ROWS[:1], (None,)), (ROWS[:2], (30.0, None, 30.0))])
def test_few_rows_and_equal_numbers_make_a_figure_too(rows: Sequence[Row], psnr: Sequence[float | None]) -> None:
    document = table({row.name: psnr for row in ROWS}, rows)
    assert svg(differences_figure(document)) == svg(differences_figure(document))
    assert int.from_bytes(png(differences_figure(document))[16:20]) == PNG_SCALE * 960
