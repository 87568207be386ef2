"""Lines of text for people."""

from __future__ import annotations

import pytest

from graings.cli.terminal import busy_status


def test_a_status_is_shown_only_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for forced, shown in (("", False), ("1", True)):
        monkeypatch.setenv("FORCE_COLOR", forced)
        with busy_status("reading [the] capture"):
            pass
        assert ("reading [the] capture" in capsys.readouterr().out) == shown
