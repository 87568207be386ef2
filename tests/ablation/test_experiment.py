"""Ablations of a tiny capture: what is run, what is not run again, what is refused, and the table."""

from __future__ import annotations

import json
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest

from graings.ablation.experiment import Ablation
from graings.ablation.rows import ROWS
from graings.capture.synthetic import write_synthetic
from graings.errors import CaptureError, CheckpointError, ConfigError
from graings.storage.checkpoint import load_model
from tests.ablation.tiny import SETTINGS, table

NAMES = [row.name for row in ROWS]


def ablation(folder: Path, capture: Path, **options: Any) -> Ablation:
    return Ablation(folder, capture, **({"preset": "draft", "settings": SETTINGS, "threads": 1} | options))


def carry_out(experiment: Ablation) -> list[str]:
    """Train everything that is left; returns the folders in order."""
    done = []
    for job, run in experiment:
        assert list(run)
        done.append(job.folder.relative_to(experiment.folder).as_posix())
    return done


@pytest.fixture(scope="module")
def folder(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All rows with one seed, and two of them with another."""
    where = tmp_path_factory.mktemp("ablation") / "all"
    assert carry_out(ablation(where, capture, seeds=(0,))) == [f"{name}/seed-0" for name in NAMES]
    pair = ablation(where, capture, rows=("full", "no_l_def"), seeds=(0, 3))
    assert carry_out(pair) == ["full/seed-3", "no_l_def/seed-3"]
    return where


def test_unnamed_rows_that_equal_the_full_model_are_left_out(capture: Path, tmp_path: Path) -> None:
    whole = ablation(tmp_path, capture, preset="long", settings={**SETTINGS, "batch": 1})
    assert [row.name for row in whole.rows] == [name for name in NAMES if name != "no_rigidity"]
    assert ["no_rigidity" in note and "left out" in note for note in whole.notes] == [True]
    with pytest.raises(ConfigError, match="no_rigidity"):
        ablation(tmp_path, capture, preset="long", settings={**SETTINGS, "batch": 1}, rows=("no_rigidity",))


def everything_in(folder: Path) -> dict[str, bytes]:
    runs = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in runs}


def test_every_run_is_an_ordinary_run_with_the_options_of_its_row(folder: Path) -> None:
    for row in ROWS:
        model = load_model(folder / row.name / "seed-0")
        assert (model.iteration, model.finished, model.config.seed) == (6, True, 0)
        assert (
            model.config.scene.model_dump().items()
            >= {
                key.removeprefix("scene."): value for key, value in row.options.items() if key.startswith("scene.")
            }.items()
        )


def test_the_table_holds_every_row_and_seed_also_unfinished_ones(folder: Path) -> None:
    document = table(folder)
    assert [row["name"] for row in document["rows"]] == NAMES
    assert document["split"] == "val"
    for row in document["rows"]:
        twice = row["name"] in ("full", "no_l_def")
        assert [(run["seed"], run["finished"]) for run in row["runs"]] == [(0, True), (3, twice)]
        assert row["finished"] == row["psnr"]["runs"] == 1 + twice
        assert (row["psnr"]["deviation"] is not None) is twice


def test_a_difference_is_to_the_full_model_of_the_same_seed_on_validation_views(folder: Path) -> None:
    def measured(name: str, seed: int) -> float:
        splits = json.loads((folder / name / f"seed-{seed}" / "metrics.json").read_text())["splits"]
        return float(splits["val"]["psnr"])

    for row in table(folder)["rows"]:
        for run in row["runs"]:
            if run["finished"]:
                expected = measured(row["name"], run["seed"]) - measured("full", run["seed"])
                assert run["difference"] == pytest.approx(expected, abs=1e-12)
        known = [run["difference"] for run in row["runs"] if run["finished"]]
        assert row["difference"]["mean"] == pytest.approx(sum(known) / len(known), abs=1e-12)


def test_the_table_and_the_figure_name_every_row_with_the_papers_difference(folder: Path) -> None:
    page = (folder / "ablation.md").read_text().splitlines()
    lines = {line.split("|")[1].strip(): line for line in page if line.startswith("| ")}
    figure = ElementTree.parse(folder / "ablation.svg").getroot()
    words = {element.text for element in figure.iter() if element.tag.endswith("}text")}
    for row in ROWS:
        assert row.label in lines
        if row.name != "full":
            assert row.label in words
    assert "\N{MINUS SIGN}1.34" in lines["without stop-gradient"]
    assert "2 of 2" in lines["without L_def"]
    assert (folder / "ablation.png").read_bytes().startswith(b"\x89PNG")


def test_a_second_call_runs_nothing_and_changes_nothing(folder: Path, capture: Path) -> None:
    before = everything_in(folder)
    again = ablation(folder, capture, seeds=(0,), threads=2)  # threads change no bit, so they may differ
    assert again.pending() == ()
    assert carry_out(again) == []
    assert everything_in(folder) == before


def test_an_interrupted_run_resumes_where_it_stopped_and_ends_the_same(
    folder: Path, capture: Path, tmp_path: Path
) -> None:
    first = ablation(tmp_path / "a", capture, rows=("full", "no_residual"), seeds=(0,))
    for _, run in first:
        for step in run:
            if step.iteration == 4:
                run.save()
                break
        break
    assert table(tmp_path / "a")["rows"][0]["finished"] == 0
    second = ablation(tmp_path / "a", capture, rows=("full", "no_residual"), seeds=(0,))
    starts = []
    for _, run in second:
        starts.append(run.iteration)
        list(run)
    assert starts == [4, 0]
    for place in ("full/seed-0", "no_residual/seed-0"):
        whole, halves = (json.loads((where / place / "metrics.json").read_text()) for where in (folder, tmp_path / "a"))
        assert halves["splits"] == whole["splits"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"settings": SETTINGS | {"iterations": 7}}, r"iterations was 6 and is now 7"),
        ({"settings": SETTINGS | {"loss.ssim": 0.5}}, r"loss\.ssim was 0\.2 and is now 0\.5"),
        ({"preset": "standard"}, r"preset was 'draft' and is now 'standard'"),
    ],
)
def test_other_options_are_refused_by_name_with_the_way_out(
    folder: Path, capture: Path, changes: dict[str, Any], words: str
) -> None:
    before = everything_in(folder)
    with pytest.raises(ConfigError, match=rf"{words}.*new folder"):
        ablation(folder, capture, rows=("no_l_temp",), seeds=(9,), **changes)
    assert everything_in(folder) == before


def test_a_run_of_other_options_in_the_place_of_a_row_is_refused(folder: Path, capture: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (folder / "no_residual" / "seed-0").rename(tmp_path / "full" / "seed-0")
    try:
        with pytest.raises(ConfigError, match=r"scene\.residual was False and is now True"):
            ablation(tmp_path, capture, rows=("full",), seeds=(0,))
    finally:
        (tmp_path / "full" / "seed-0").rename(folder / "no_residual" / "seed-0")


def test_another_capture_is_refused(folder: Path, tmp_path: Path) -> None:
    other = write_synthetic(tmp_path / "other", seed=2, frames=12, size=32, bodies=2)
    with pytest.raises(ConfigError, match="another capture"):
        ablation(folder, other)


def test_the_folder_of_a_single_run_is_refused(folder: Path, capture: Path) -> None:
    with pytest.raises(CheckpointError, match="single run"):
        ablation(folder / "full" / "seed-0", capture)


def test_a_damaged_table_is_refused_with_its_remedy(capture: Path, tmp_path: Path) -> None:
    (tmp_path / "ablation.json").write_text("{")
    with pytest.raises(CheckpointError, match="Delete it"):
        ablation(tmp_path, capture)


def test_a_capture_without_validation_views_is_refused_before_anything_is_run(capture: Path, tmp_path: Path) -> None:
    blind = shutil.copytree(capture, tmp_path / "blind", ignore=shutil.ignore_patterns("*val*"))
    with pytest.raises(CaptureError, match="validation"):
        ablation(tmp_path / "out", blind)
    assert not (tmp_path / "out").exists()
