"""`graings plan`: a dry run for people and for programs."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

from graings.cli.main import main
from graings.config import TrainConfig
from graings.plan.cost import CALIBRATION_FILE
from graings.plan.plan import Plan
from graings.report.machine import machine_facts
from graings.storage.files import write_document
from tests.plan.fixed_cameras import noisy, texture, write_fixed
from tests.training.test_calibration import MADE


@pytest.fixture
def calibrated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that was calibrated before."""
    folder = tmp_path / "cache" / "graings"
    folder.mkdir(parents=True)
    write_document(folder / CALIBRATION_FILE, MADE.model_copy(update={"cpu": machine_facts().cpu}))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def planned(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as end:
        main(["plan", *arguments, "--threads", "1"])
    assert end.value.code == 0
    return capsys.readouterr().out


@pytest.mark.usefixtures("calibrated")
def test_the_table_names_every_part_and_the_minutes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    capture = write_fixed(tmp_path / "c", lambda c, t: texture(16), cameras=6, times=1, size=16)
    text = planned(capsys, str(capture), "--preset", "draft")
    assert "6 training images of 16x16 px, 1 time" in text
    rows = {line[:16].strip(): line for line in text.splitlines()}
    assert "leave out    representable" in rows["deformation"]
    assert 'plan.keep=["deformation"]' in rows["deformation"]
    assert "draft, 1,100 steps: about" in text
    assert f"graings train {capture} -o RUN --preset draft" in text
    assert not (tmp_path / "RUN").exists()


@pytest.mark.usefixtures("calibrated")
def test_what_a_row_says_can_be_done_by_its_arguments(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    capture = write_fixed(tmp_path / "c", lambda c, t: texture(16), cameras=6, times=2, size=16)

    def row(part: str, *arguments: str) -> str:
        return next(line for line in planned(capsys, str(capture), *arguments).splitlines() if line.startswith(part))

    proposed = row("preset", "--preset", "draft")
    assert "proposed" in proposed
    assert "keep" in row("preset", *shlex.split(proposed.rpartition("to do so: ")[2]))
    proposed = row("deformation")
    assert "proposed" in proposed
    dropped = row("deformation", *shlex.split(proposed.rpartition("to do so: ")[2]))
    assert "leave out" in dropped
    assert "keep" in row("deformation", *shlex.split(dropped.rpartition("to keep it: ")[2]))


@pytest.mark.usefixtures("calibrated")
def test_the_printed_command_trains_what_was_planned(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    capture = write_fixed(tmp_path / "a capture", lambda c, t: texture(16), cameras=6, times=1, size=16)
    settings = ("--set", 'plan.keep=["residual"]', "--set", "preset=draft", "--aggressive")
    (line,) = [line for line in planned(capsys, str(capture), *settings).splitlines() if line.startswith("Train: ")]
    expected = ["graings", "train", str(capture), "-o", "RUN", "--preset", "draft"]
    expected += ["--set", 'plan.keep=["residual"]', "--set", "plan.mode=aggressive"]
    assert shlex.split(line.removeprefix("Train: ")) == expected


@pytest.mark.usefixtures("calibrated")
@pytest.mark.parametrize(("flags", "decision"), [((), "propose"), (("--aggressive",), "drop")])
def test_json_is_the_plan_document(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, flags: tuple[str, ...], decision: str
) -> None:
    capture = write_fixed(tmp_path / "c", lambda c, t: noisy(texture(), 0.01, c, t), cameras=2)
    plan = Plan.model_validate(json.loads(planned(capsys, str(capture), "--json", *flags)))
    found = plan.decision("deformation")
    assert found is not None
    assert (found.decision, found.kind) == (decision, "estimated")
    assert plan.prediction is not None
    assert set(plan.alternatives) == {"draft", "standard", "fine"}
    assert (plan.apply(TrainConfig()).scene.deformation == "none") == bool(flags)
