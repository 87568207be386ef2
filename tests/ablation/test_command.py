"""`graings ablate` as a person types it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from graings.cli.main import main
from graings.cli.progress import TrainingProgress
from graings.storage.checkpoint import load_model
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
