"""`graings doctor`: what it says of the packages of extras."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from graings.cli.doctor import OPTIONAL
from graings.cli.main import app

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"


def rows(table: str) -> dict[str, str]:
    """The lines of the table by the name of their check."""
    return {line.split()[1]: line for line in table.splitlines() if len(line.split()) > 1}


@pytest.mark.parametrize("package", OPTIONAL)
def test_a_package_of_an_extra_is_listed_and_one_that_is_missing_named_with_the_command_that_brings_it(
    package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(package)
    monkeypatch.setenv("COLUMNS", "200")
    assert rows(CliRunner().invoke(app, ["doctor"]).output)[package].split()[0] == "ok"
    monkeypatch.setitem(sys.modules, package, None)
    ended = CliRunner().invoke(app, ["doctor"])
    row = rows(ended.output)[package]
    assert row.split()[0] == "missing"
    assert f"pip install 'graings[{OPTIONAL[package][0]}]'" in row
    assert ended.exit_code == 0


def test_every_package_of_the_extras_for_users_is_checked() -> None:
    extras = tomllib.loads(PROJECT.read_text())["project"]["optional-dependencies"]
    wanted = {
        (requirement.split(">")[0].split("=")[0], extra)
        for extra in ("video", "splats")
        for requirement in extras[extra]
    }
    assert wanted == {(package, extra) for package, (extra, _) in OPTIONAL.items()}
