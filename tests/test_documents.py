"""What the documents name exists: files, functions, options and commands."""

from __future__ import annotations

import ast
import json
import re
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest

from graings.cli.main import app
from graings.config import ConfigSection, TrainConfig, make_config

ROOT = Path(__file__).resolve().parent.parent
# The log of experiments keeps the names of its day.
DOCUMENTS = [ROOT / "README.md", *sorted({*(ROOT / "docs").glob("*.md")} - {ROOT / "docs/experiments.md"})]
FOLDERS = "graings|jobs|service|tests|scripts|benchmarks|docker|docs"

documents = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)


def option_names(section: type[ConfigSection], prefix: str = "") -> set[str]:
    names = set()
    for name, field in section.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, ConfigSection):
            names |= option_names(kind, f"{prefix}{name}.")
        else:
            names.add(f"{prefix}{name}")
    return names


def value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


@documents
def test_a_named_file_exists(document: Path) -> None:
    named = re.findall(rf"`((?:{FOLDERS})/[\w./-]*)`", document.read_text())
    assert [path for path in named if not (ROOT / path).exists()] == []


@documents
def test_a_name_after_a_file_is_defined_in_it(document: Path) -> None:
    wrong = []
    for path, name in re.findall(r"`([\w/]+\.py)` `(\w+)`", document.read_text()):
        defined: set[str] = set()
        for node in ast.parse((ROOT / path).read_text()).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                defined.add(node.name)
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                defined |= {target.id for target in targets if isinstance(target, ast.Name)}
        if name not in defined:
            wrong.append(f"{path} has no {name}")
    assert wrong == []


@documents
def test_a_named_option_exists_and_takes_the_value(document: Path) -> None:
    text = document.read_text()
    known = option_names(TrainConfig)
    sections = "|".join(sorted({name.split(".")[0] for name in known if "." in name}))
    named = re.findall(rf"`((?:{sections})\.[a-z_]+)`", text)
    assert sorted(set(named) - known - {"plan.json", "scene.json"}) == []  # files, not options
    before = "--set " if document.name == "api.md" else "(?:--set |`)"  # backticks there hold parameters of requests
    for name, given in re.findall(rf"{before}([a-z_.]+)=([^\s`]+)", text):
        make_config(overrides={name: value(given)})


@documents
def test_a_named_command_exists(document: Path) -> None:
    verbs = {command.name or command.callback.__name__ for command in app.registered_commands if command.callback}
    verbs |= set(entry_points(group="graings.commands").names)
    named = re.findall(r"^(?:.*`)?graings ([a-z]+)", document.read_text(), flags=re.MULTILINE)
    assert sorted(set(named) - verbs) == []
