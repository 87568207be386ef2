"""`graings doctor`: what it says of the packages of extras."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from graings.cli.doctor import OPTIONAL
from graings.cli.main import app, main

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


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_a_missing_pycolmap_is_said_with_what_needs_it_and_a_remedy_that_works(
    machine: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.setattr("platform.machine", lambda: machine)
    remedy = {"x86_64": "pip install 'graings[colmap]'", "aarch64": "pycolmap has no build for Linux on aarch64"}[
        machine
    ]
    row = rows(CliRunner().invoke(app, ["doctor"]).output)["pycolmap"]
    assert row.split()[0] == "missing"
    assert f"no lens distortion, triangulation or `graings capture`: {remedy}" in row
    with pytest.raises(SystemExit) as ended:
        main(["capture", str(tmp_path), "-o", str(tmp_path / "made")])
    assert ended.value.code == 65
    message = capsys.readouterr().err
    assert message.startswith(f"{tmp_path}: finding the cameras needs the package pycolmap.")
    assert remedy in message
    assert list(tmp_path.iterdir()) == []


def test_every_package_of_the_extras_for_users_is_checked() -> None:
    extras = tomllib.loads(PROJECT.read_text())["project"]["optional-dependencies"]
    wanted = {
        (requirement.split(">")[0].split("=")[0], extra)
        for extra in ("video", "splats")
        for requirement in extras[extra]
    }
    assert wanted == {(package, extra) for package, (extra, _) in OPTIONAL.items()}
