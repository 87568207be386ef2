"""The Python interface: the example of docs/python.md runs as it stands, with fewer pixels and steps."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import graings
from graings.config import TrainConfig, make_config

DOCUMENT = Path(__file__).parent.parent / "docs" / "python.md"


def example() -> str:
    """The program in the document, made small enough for a test."""
    (code,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    for written, small in (
        ("size=200, views=60", "size=32, views=8"),
        ('{"seed": 1}', '{"seed": 1, "iterations": 12}'),
        ("seconds=2, width=400", "seconds=0.1, width=32"),
    ):
        assert written in code
        code = code.replace(written, small)
    return code


def test_the_example_of_the_document_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("av")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(example(), str(DOCUMENT), "exec"), names)
    held_out = names["held_out"]
    assert isinstance(held_out, np.ndarray)
    assert held_out.shape == (32, 32, 3)
    assert held_out.dtype == np.float32
    assert 0 <= held_out.min() < held_out.max() <= 1
    for file in ("side.png", "turn.mp4", "scene.html", "half.ply", "runs/walker/metrics.json"):
        assert (tmp_path / file).stat().st_size > 500
    printed = capsys.readouterr().out
    assert re.search(r"12 of 12: \d+\.\d\d dB", printed)
    assert re.search(r"test: \d+\.\d\d dB, SSIM 0\.\d{4}", printed)
    assert "splats at t = 0.5" in printed


def test_the_example_has_about_twenty_lines_and_the_table_every_name() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    assert len([line for line in example().splitlines() if line.strip()]) <= 20
    assert re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE) == list(
        dict.fromkeys(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
    )
    assert sorted(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)) == sorted(graings.__all__)


def test_every_name_exists_and_is_described() -> None:
    for name in graings.__all__:
        assert inspect.getdoc(getattr(graings, name)), name
    assert set(graings.__all__) <= set(dir(graings))
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        graings.trian  # noqa: B018


def test_the_import_alone_needs_no_torch() -> None:
    code = "import sys, graings; print('torch' in sys.modules, len(dir(graings)))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split()[0] == "False"


def test_a_wrong_parameter_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="waler"):
        graings.synthesize("waler", tmp_path / "capture")
    with pytest.raises(ValueError, match="psd"):
        graings.save_image(tmp_path / "a.psd", np.zeros((2, 2, 3)))
    with pytest.raises(graings.GraingsError, match="nothing"):
        graings.open_scene(tmp_path / "nothing")
    with pytest.raises(ValueError, match="six numbers"):
        graings.export_model(tmp_path, tmp_path / "a.ply", box=(0, 1, 2))
    with pytest.raises(ValueError, match=r"a number of frames is not used by a \.ply file"):
        graings.export_model(tmp_path, tmp_path / "a.ply", frames=3)
    with pytest.raises(graings.GraingsError, match="there is no folder"):
        graings.export_model(tmp_path, tmp_path / "none" / "a.ply")
    with pytest.raises(ValueError, match=r"a \.graings file holds the whole scene"):
        graings.export_model(tmp_path, tmp_path / "a.graings", seen=True)


@pytest.mark.parametrize(
    ("preset", "options", "trained"),
    [
        (None, None, "standard"),
        (None, {"preset": "fine"}, "fine"),
        ("draft", None, "draft"),
        ("draft", {"seed": 1}, "draft"),
        ("fine", {"preset": "fine"}, "fine"),
    ],
)
def test_the_preset_is_a_parameter_or_an_option(
    preset: str | None, options: dict[str, object] | None, trained: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Stopped(Exception):
        pass

    def create(capture: Path, run: Path, config: TrainConfig) -> None:
        assert config.preset == trained
        assert config == make_config(trained, {**(options or {}), "preset": trained})
        raise Stopped

    monkeypatch.setattr(graings.TrainingRun, "create", create)
    with pytest.raises(Stopped):
        graings.train(tmp_path, tmp_path / "run", preset=preset, options=options)


def test_two_presets_are_refused_by_their_names(tmp_path: Path) -> None:
    with pytest.raises(graings.GraingsError, match="preset: is draft, and in options fine"):
        graings.train(tmp_path, tmp_path / "run", preset="draft", options={"preset": "fine"})
    assert not (tmp_path / "run").exists()
