"""`graings ablate` as a person types it."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from pathlib import Path

import pytest
from torch import Tensor

from graings.cli.main import main
from graings.cli.progress import TrainingProgress
from graings.storage.checkpoint import load_model
from graings.training.guard.guard import Gradient, Guard, StepCheck
from tests.ablation.tiny import SETTINGS, table


def graings(*arguments: object) -> int:
    """The exit code of a command line."""
    with pytest.raises(SystemExit) as exit_:
        main([str(argument) for argument in arguments])
    assert isinstance(exit_.value.code, int)
    return exit_.value.code


def test_ctrl_c_ends_the_command_with_a_checkpoint_and_the_same_command_goes_on(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    sets = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
    command = ["ablate", "--rows", "full", "no_l_res", "--seeds", 2, "--preset", "draft", *sets, "-o", out, capture]
    with monkeypatch.context() as patch:
        patch.setattr(TrainingProgress, "show", lambda progress, step: os.kill(os.getpid(), signal.SIGINT))
        assert graings(*command) == 128 + signal.SIGINT
    assert "2 runs left" in capsys.readouterr().out
    assert load_model(out / "full" / "seed-2").iteration == 1
    assert graings(*command) == 0
    assert [row["finished"] for row in table(out)["rows"]] == [1, 1]
    assert "ablation.md" in capsys.readouterr().out
    assert graings(*command) == 0
    assert "2 runs, 2 of them finished" in capsys.readouterr().out


def test_a_row_that_diverges_does_not_keep_the_others_from_being_trained(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    sets = [word for key, value in {**SETTINGS, "guard.rollbacks": 0}.items() for word in ("--set", f"{key}={value}")]
    command = ["ablate", "--rows", "full", "no_l_res", "--seeds", 2, "--preset", "draft", *sets, "-o", out, capture]
    check = Guard.check_step

    def check_step(guard: Guard, iteration: int, loss: Tensor, gradients: Sequence[Gradient]) -> StepCheck:
        full = (out / "full/seed-2").exists() and not (out / "no_l_res/seed-2").exists()
        return check(guard, iteration, loss * float("nan") if full and iteration > 1 else loss, gradients)

    monkeypatch.setattr(Guard, "check_step", check_step)
    assert graings(*command) == 70
    assert [row["finished"] for row in table(out)["rows"]] == [0, 1]
    assert str(out / "full/seed-2") in capsys.readouterr().err.replace("\n", "")
    assert graings(*command) == 0  # resumed, it does not diverge again
    assert [row["finished"] for row in table(out)["rows"]] == [1, 1]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--rows", "full", "no_such"], "no_such"),
        (["--set", "scene.residual=false"], "scene.residual"),
        (["--seeds", "-1"], "--seeds"),
        (["--set", "seed=3"], "--seeds"),
    ],
)
def test_a_mistake_is_one_clear_message_and_leaves_nothing_behind(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], word: str
) -> None:
    assert graings("ablate", capture, "-o", tmp_path / "out", *arguments) == 2
    assert word in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
