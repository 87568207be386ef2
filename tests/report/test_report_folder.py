from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from graings.camera.camera import Camera, View
from graings.camera.units import Units
from graings.cli.main import main
from graings.config import make_config
from graings.errors import CheckpointError
from graings.report.folder import report_runs, report_training
from graings.report.render_precision import render_part, settings
from graings.storage.checkpoint import TrainingState, load_model, save_checkpoint
from graings.storage.model import Model
from tests.models import tiny_scene
from tests.report.reports import metrics, point, write_run

CURVE = (point(1, 20.0), point(10, 30.0, iteration=400, gaussians=4000))


def refuse(constant: str) -> float:
    raise AssertionError(f"{constant} is not strict JSON")


def read(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / "work_precision.json").read_text(), parse_constant=refuse)
    return document


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with an untrained model."""
    folder = write_run(tmp_path_factory.mktemp("runs") / "tiny", metrics(*CURVE))
    eyes = ((0.0, -2.0, 0.5), (2.0, 0.0, 0.3))
    cameras = [Camera.look_at(eye, (0, 0, 0), fov=0.8, width=40, height=30) for eye in eyes]
    views = [View(f"view-{i}", camera, 0.5 * i) for i, camera in enumerate(cameras)]
    scene = tiny_scene()
    save_checkpoint(
        folder,
        scene=scene,
        state=TrainingState({}, {}),
        units=Units((0.0, 0.0, 0.0), 1.0, 0.0, 1.0, (0.0, 0.0, 1.0)),
        background=(1.0, 1.0, 1.0),
        views={"train": views, "val": views, "test": []},
        config=make_config("draft"),
        iteration=400,
        finished=True,
    )
    return folder


@pytest.fixture(scope="module")
def model(run: Path) -> Model:
    return load_model(run)


def test_every_setting_is_measured_against_the_rendering_without_cut_offs(model: Model) -> None:
    part = render_part("tiny", model)
    points = part.points
    assert [p.setting for p in points] == list(settings())
    assert (part.views.split, part.views.names) == ("val", ("view-0", "view-1"))
    assert all(p.ms.median > p.ms.networks > 0 and p.ms.iqr >= 0 for p in points)

    def error(sweep: str, key: str) -> list[float]:
        chosen = sorted(
            (p for p in points if p.setting.sweep in (sweep, "default")), key=lambda p: getattr(p.setting, key)
        )
        return [p.err.rmse for p in chosen]

    # Less is left out, less is wrong; and next to nothing left out is next to nothing wrong.
    assert error("alpha_min", "alpha_min") == sorted(error("alpha_min", "alpha_min"))
    assert 0 < min(error("alpha_min", "alpha_min")) < 1e-4
    assert error("resolution", "scale") == sorted(error("resolution", "scale"), reverse=True)
    assert part.pareto == tuple(i for i in part.pareto if points[i].on_front)
    assert sum(p.on_front for p in points) == len(part.pareto) >= 1


def test_a_small_budget_draws_fewer_views_but_every_setting(model: Model) -> None:
    part = render_part("tiny", model, budget_s=0.0)
    assert (len(part.views.names), part.rounds) == (1, 2)
    assert len(part.points) == len(settings())


def test_a_report_of_several_runs_is_complete(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="PNG needs the extra plot")
    bare = write_run(tmp_path / "bare", metrics(*CURVE))
    written = report_runs([run, bare], tmp_path / "report", budget_s=0.1)
    assert sorted(path.name for path in (tmp_path / "report").iterdir()) == sorted(written.files)
    assert {"render.svg", "render.png", "training.svg", "training.png", "points.csv"} < set(written.files)
    document = read(tmp_path / "report")
    assert [part["run"]["name"] for part in document["training"]] == ["tiny", "bare"]
    assert [part["run"]["name"] for part in document["render"]] == ["tiny"]
    assert any("bare" in note and "no checkpoint" in note for note in document["omissions"])
    assert written.notes == tuple(document["omissions"])


def test_a_report_written_again_keeps_nothing_that_contradicts_it(run: Path, tmp_path: Path) -> None:
    report_runs([run], tmp_path, budget_s=0.1)
    report_runs([run], tmp_path, render=False)
    assert not list(tmp_path.glob("render.*"))
    assert read(tmp_path)["render"] == []


def test_without_matplotlib_the_rest_is_written_and_the_extra_is_named(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SystemExit) as ending:
        main(["report", str(run), "-o", str(tmp_path), "--no-render", "--threads", "1"])
    assert ending.value.code == 0
    assert "PNG left out: matplotlib is not installed (pip install 'graings[plot]')" in capsys.readouterr().out
    assert (tmp_path / "training.svg").exists()
    assert not list(tmp_path.glob("*.png"))


def test_a_run_in_the_middle_of_its_training_has_a_report_too(tmp_path: Path) -> None:
    report_training("tiny", metrics(*CURVE, splits={}), make_config("draft", {"iterations": 5000}), tmp_path)
    (part,) = read(tmp_path)["training"]
    assert part["run"]["status"] == "unfinished"
    assert [entry["target_db"] for entry in part["time_to_psnr"] if entry["train_s"]] == [25, 30]


def test_a_run_without_numbers_leaves_no_report(run: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"nothing.metrics\.json: not found"):
        report_runs([run, tmp_path / "nothing"], tmp_path / "report")
    assert not (tmp_path / "report").exists()


@pytest.mark.parametrize(("names", "code", "word"), [(["nothing"], 65, "metrics.json"), (["run", "run"], 2, "twice")])
def test_a_mistake_is_one_message_with_its_exit_code(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], names: list[str], code: int, word: str
) -> None:
    places = [str(run if name == "run" else tmp_path / name) for name in names]
    with pytest.raises(SystemExit) as ending:
        main(["report", *places, "-o", str(tmp_path / "report")])
    assert ending.value.code == code
    assert word in " ".join(capsys.readouterr().err.split())
