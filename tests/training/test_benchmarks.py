"""The scripts in `benchmarks/` that train: what they take for the run that was asked for."""

from __future__ import annotations

import importlib
import subprocess
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.capture.synthetic.catalogue import scene_named
from graings.capture.synthetic.drawing import draw
from graings.capture.synthetic.planned_view import planned_views
from graings.config import CaptureConfig
from graings.storage.files import write_document
from graings.storage.run_folder import METRICS_FILE
from tests.training.micro import micro_config

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a script of `benchmarks/` by its name."""
    monkeypatch.syspath_prepend(BENCHMARKS)

    def load(name: str) -> ModuleType:
        return importlib.import_module(name)

    return load


def test_the_last_row_of_the_ladder_is_fine(scripts: Any) -> None:
    """An option that `fine` and `paper` set differently and no row takes would be worth nothing in the table."""
    ladder = scripts("ladder")
    ladder.check_ladder(20_000)
    names = [name for row in ladder.ROWS for name in row.options]
    assert len(names) == len(set(names))
    assert ladder.config_of(0, 20_000, 0, 1).batch == 1
    assert ladder.config_of(len(ladder.ROWS) - 1, 20_000, 0, 1).iterations == 5_000


def test_a_ladder_that_misses_an_option_is_refused(scripts: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    ladder = scripts("ladder")
    monkeypatch.setattr(ladder, "ROWS", ladder.ROWS[:-1])
    with pytest.raises(SystemExit, match=r"not fine.*time_window"):
        ladder.check_ladder(20_000)


def test_every_addition_of_the_ladder_is_undone_alone(scripts: Any) -> None:
    """From the losses to averaging; the budget, the time window and the plan show nothing in scenes that need none."""
    ladder, single = scripts("ladder"), scripts("leave_one_out")
    rows = [row for row in ladder.ROWS if row.name in {"losses", "appearance", "rasterizer", "optimizer", "end"}]
    undone = [name for addition in single.ADDITIONS for name in addition.options]
    assert sorted(undone) == sorted(name for row in rows for name in row.options)
    full = single.config_of(single.ADDITIONS[0], "standard", 3, 1)
    for addition in single.ADDITIONS[1:]:
        config = single.config_of(addition, "standard", 3, 1)
        assert config.seed == 3
        for name in undone:
            source = single.PAPER if name in addition.options else full
            assert single.option(config, name) == single.option(source, name), (addition.name, name)


def test_an_addition_that_the_preset_lacks_has_no_row(scripts: Any, tmp_path: Path) -> None:
    single = scripts("leave_one_out")
    for preset, has in (("draft", False), ("standard", True)):
        lines = list(single.table(tmp_path, [tmp_path / "scene"], preset, [0]))
        assert any("residual_view" in line for line in lines) == has
        assert any("reflection" in line for line in lines)


def test_the_program_for_other_cpus_compiles_without_python(scripts: Any) -> None:
    program = scripts("other_cpu")
    command = ["g++", *program.FLAGS, "-fsyntax-only", *program.sources()]
    assert subprocess.run(command, capture_output=True, text=True, check=False).stderr == ""


def test_a_capture_that_cannot_be_trained_is_named_in_one_line(scripts: Any, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no_capture"):
        scripts("runs").train(tmp_path / "run", tmp_path / "no_capture", micro_config())


@pytest.mark.slow(reason="a training with its report")
def test_a_run_is_finished_once_and_refused_with_other_options(scripts: Any, micro: Path, tmp_path: Path) -> None:
    runs = scripts("runs")
    folder, config = tmp_path / "run", micro_config(iterations=5)
    assert runs.finished(folder) is None
    runs.train(folder, micro, config)
    metrics = runs.finished(folder)
    written = (folder / "metrics.json").stat().st_mtime_ns
    runs.train(folder, micro, config.model_copy(update={"threads": 2}))  # threads change no number
    assert runs.finished(folder) == metrics is not None
    assert (folder / "metrics.json").stat().st_mtime_ns == written
    with pytest.raises(SystemExit, match="other seed"):
        runs.train(folder, micro, config.model_copy(update={"seed": 1}))
    with pytest.raises(SystemExit, match="other capture"):
        runs.train(folder, tmp_path / "elsewhere" / "micro", config)


def test_published_numbers_stand_beside_their_own_protocol(scripts: Any) -> None:
    """Means of seven scenes as the projects publish them, in dB."""
    tables = scripts("field_tables")
    means = {"white-800": 38.64, "black-400": 43.31, "black-800": 42.41}
    for name, mean in means.items():
        protocol = tables.PROTOCOLS[name]
        assert sum(protocol.published.values()) / 7 == pytest.approx(mean, abs=0.006)
        assert name == f"{protocol.background}-{protocol.max_side}"


def test_a_run_is_finished_only_with_the_metrics_of_its_last_iteration(
    scripts: Any, micro: Path, tmp_path: Path
) -> None:
    runs, folder = scripts("runs"), tmp_path / "run"
    runs.train(folder, micro, micro_config(iterations=4))
    metrics = runs.finished(folder)
    assert metrics.iterations == 4
    interrupted = metrics.model_copy(update={"iterations_planned": 9})  # and evaluated
    write_document(folder / METRICS_FILE, interrupted)
    assert runs.finished(folder) is None
    diverged = metrics.model_copy(update={"diverged": True, "diverged_reason": "the loss"})
    write_document(folder / METRICS_FILE, diverged)
    with pytest.raises(SystemExit, match="the loss"):
        runs.finished(folder)


def test_nothing_moves_in_any_split_of_the_resting_rig(scripts: Any, tmp_path: Path) -> None:
    """Held-out views had times of the moving scene: no model at rest could have more than 17 dB on most of them."""
    capture = load_capture(scripts("plan_regret").resting(tmp_path / "rig", 24, 24), CaptureConfig(background="white"))
    world = scene_named("rig").build(0)
    images = ImageStore((1.0, 1.0, 1.0))
    planned = planned_views(world, size=24, views=24, seed=0)
    for split, frames in (("train", capture.train), ("val", capture.val), ("test", capture.test)):
        assert len(frames) == len(planned[split])
        for view, frame in zip(planned[split], frames, strict=True):
            rgba = draw(world, view.viewpoint, 0.0).rgba / 255.0
            still = 0.1 + 0.8 * (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:])
            assert np.abs(images.rgb(frame) - still).mean() < 0.02, frame.name


def test_the_quantiles_of_students_t_fall_to_that_of_the_normal(scripts: Any) -> None:
    quantiles = scripts("plan_regret").T_95
    assert quantiles[0] == 12.706
    assert all(a > b > 1.96 for a, b in pairwise(quantiles))
