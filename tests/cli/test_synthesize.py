"""From a name to a capture, a model and its score, by the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from graings.capture.load import load_capture
from graings.image_encoding import encode_image
from graings.render import render
from graings.report.metrics_document import read_metrics
from graings.storage.checkpoint import load_model
from graings.storage.run_folder import METRICS_FILE
from tests.cli.test_cli import TINY, graings


def test_the_list_names_every_scene_and_its_question(capsys: pytest.CaptureFixture[str]) -> None:
    assert graings("synthesize", "--list") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 13
    assert any("flag" in line and "thin sheet" in line for line in lines)


def test_a_wrong_request_names_the_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert graings("synthesize", "teapot", "-o", tmp_path / "x") == 2
    assert "walker" in capsys.readouterr().err
    assert graings("synthesize", "globe") == 2
    assert graings("synthesize") == 2
    (tmp_path / "file").touch()
    assert graings("synthesize", "globe", "-o", tmp_path, "--size", 8, "--views", 1, "--processes", 1) == 65
    assert "not empty" in capsys.readouterr().err


def test_a_synthetic_scene_is_written_trained_and_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture, run = tmp_path / "ring", tmp_path / "run"
    assert graings("synthesize", "ring", "-o", capture, "--size", 32, "--views", 6, "--processes", 1) == 0
    assert len(load_capture(capture).train) == 6
    assert graings("train", capture, "-o", run, *TINY, "--set", "iterations=10") == 0
    assert read_metrics(run / METRICS_FILE).motion is None
    assert graings("evaluate", run, "--split", "between") == 0
    assert set(read_metrics(run / METRICS_FILE).splits) == {"val", "between"}
    motion = read_metrics(run / METRICS_FILE).motion
    assert motion is not None
    assert motion.points == 200
    assert motion.mean_at_rest > 0.01
    assert "motion: 200 points" in capsys.readouterr().out


def test_a_view_of_the_split_between_can_be_rendered(tmp_path: Path) -> None:
    capture, run, picture = tmp_path / "ring", tmp_path / "run", tmp_path / "view.png"
    assert graings("synthesize", "ring", "-o", capture, "--size", 32, "--views", 10, "--processes", 1) == 0
    assert graings("train", capture, "-o", run, *TINY, "--set", "iterations=10") == 0
    assert graings("render", run, "--camera", "between:0", "-o", picture) == 0
    frame, model = load_capture(capture).between[0], load_model(run)
    expected = render(model.scene, frame.camera, frame.time, model.background).color
    assert picture.read_bytes() == encode_image(expected)
