"""Lines for a person to read."""

from __future__ import annotations

import pytest

from graings.cli.terminal import waiting


def test_what_is_waited_for_is_shown_on_a_terminal_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for forced, said in (("", False), ("1", True)):
        monkeypatch.setenv("FORCE_COLOR", forced)
        with waiting("reading [the] capture"):
            pass
        assert ("reading [the] capture" in capsys.readouterr().out) == said
