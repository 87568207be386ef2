"""Options of runs that take a moment, and the table that they leave."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

SETTINGS = {
    "iterations": 6,
    "init.points": 300,
    "scene.children": 2,
    "scene.deform_width": 8,
    "scene.deform_depth": 1,
    "evaluation.first": 3,
}


def table(folder: Path) -> dict[str, Any]:
    """The document, which must be strict JSON of its schema."""
    document = json.loads((folder / "ablation.json").read_text(), parse_constant=lambda word: pytest.fail(word))
    assert document["schema"] == "graings.ablation/1"
    assert isinstance(document, dict)
    return document
