"""The page of trained models."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from urllib.parse import unquote

import pytest
from typer.testing import CliRunner

from graings.api import gallery
from graings.api.gallery import write_gallery
from graings.capture.synthetic import synthesize
from graings.cli.main import app
from graings.config import make_config
from graings.errors import CheckpointError
from graings.evaluation.metrics import SplitMetrics
from graings.report.metrics_document import read_metrics
from graings.storage.files import write_document
from graings.storage.run_folder import CHECKPOINTS, METRICS_FILE, MODEL_FILE, RECORD_FILE
from graings.training.run import TrainingRun

pytest.importorskip("av")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gallery")
    capture = synthesize("flag", folder / "flag", size=24, views=6)
    config = make_config("draft", {"iterations": 8, "init.points": 100, "evaluation.views": 1, "threads": 1})
    training = TrainingRun.create(capture, folder / "my <flag> #1", config)
    for _ in training:
        pass
    return training.folder


def test_a_gallery_has_a_clip_numbers_and_a_player_of_each_run(run: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(run, tmp_path / "second"))
    output = tmp_path / "gallery"
    answer = CliRunner().invoke(app, ["gallery", str(run), str(other), "-o", str(output), "--title", "A & B"])
    assert answer.exit_code == 0, answer.output
    assert sorted(file.name for file in output.iterdir()) == [
        "index.html",
        *("my <flag> #1.html", "my <flag> #1.png", "my <flag> #1.webp"),
        *("second.html", "second.png", "second.webp"),
    ]
    page = (output / "index.html").read_text()
    assert "<title>A &amp; B</title>" in page
    assert "my &lt;flag&gt; #1" in page
    assert "my <flag> #1" not in page
    assert page.count("deformation of a thin sheet") == 2  # what the scene of the suite asks
    assert len(re.findall(r"val \d+\.\d\d dB · \d+ min of CPU time · player with scene \d\.\d MB", page)) == 2
    for link in re.findall(r'(?:href|src|srcset)="([^"]+)"', page):
        assert (output / unquote(link)).is_file()
    assert (output / "second.webp").read_bytes()[8:12] == b"WEBP"


def test_runs_that_are_not_finished_or_share_a_name_are_refused(run: Path, tmp_path: Path) -> None:
    twice = CliRunner().invoke(app, ["gallery", str(run), str(run), "-o", str(tmp_path)])
    assert twice.exit_code == 2
    assert "rename one" in " ".join(twice.output.split())
    assert list(tmp_path.iterdir()) == []


def test_runs_of_jobs_are_named_after_their_jobs(run: Path, tmp_path: Path) -> None:
    jobs = [Path(shutil.copytree(run, tmp_path / f"{name}/run")) for name in ("first", "second")]
    found = CliRunner().invoke(app, ["gallery", *map(str, jobs), "-o", str(tmp_path / "gallery")])
    assert found.exit_code == 0, found.output
    assert {"first.webp", "second.webp"} <= {path.name for path in (tmp_path / "gallery").iterdir()}


@pytest.mark.parametrize("wrong", ["unfinished", "without metrics", "without record", "without model", "named index"])
def test_a_run_that_cannot_be_shown_is_refused_before_others_are_rendered(
    run: Path, tmp_path: Path, wrong: str
) -> None:
    other = Path(shutil.copytree(run, tmp_path / ("index" if wrong == "named index" else "second")))
    if wrong == "unfinished":
        metrics = json.loads((other / METRICS_FILE).read_text())
        (other / METRICS_FILE).write_text(json.dumps(metrics | {"iterations_planned": 10_000}))
    elif wrong == "without metrics":
        (other / METRICS_FILE).unlink()
    elif wrong == "without record":
        (other / RECORD_FILE).unlink()
    elif wrong == "without model":
        shutil.rmtree(other / CHECKPOINTS)
        (other / MODEL_FILE).unlink()
    seen: list[int] = []
    expected = ValueError if wrong == "named index" else CheckpointError
    with pytest.raises(expected, match="index" if wrong == "named index" else "second"):
        write_gallery([run, other], tmp_path / "gallery", observe=lambda done, total: seen.append(done))
    assert seen == []
    assert not (tmp_path / "gallery").exists()


def test_a_split_without_images_has_no_number(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    metrics = read_metrics(run / METRICS_FILE)
    other = Path(shutil.copytree(run, tmp_path / "second"))
    empty = metrics.model_copy(update={"splits": {**metrics.splits, "test": SplitMetrics.over([])}})
    write_document(other / METRICS_FILE, empty)
    monkeypatch.setattr(gallery, "SECONDS", 0.1)
    text = write_gallery([other], tmp_path / "gallery").read_text()
    assert re.search(r"<p>val \d+\.\d\d dB · \d+ min of CPU time", text)
    assert "test" not in text
