"""Documents of a run: what is written comes back, and what does not fit is named by file, field and remedy."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from graings.config import make_config
from graings.document import read_document
from graings.errors import CheckpointError
from graings.report.machine import MachineFacts, machine_facts, version_facts
from graings.report.metrics_document import Metrics, config_hash, read_metrics
from graings.report.run_record import read_record
from graings.storage.files import write_document
from tests.report.reports import metrics, point, values


def test_metrics_come_back_as_they_were_written(tmp_path: Path) -> None:
    written = metrics(point(1, 25.0))
    write_document(tmp_path / "metrics.json", written)
    assert read_metrics(tmp_path / "metrics.json") == written
    assert json.loads((tmp_path / "metrics.json").read_text()) == values(point(1, 25.0))


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_number_that_json_does_not_have_is_refused_by_its_field(number: float) -> None:
    broken = values(point(1, 25.0))
    broken["splits"]["val"]["views"][1]["psnr"] = number
    with pytest.raises(ValidationError, match=r"splits\.val\.views\.1\.psnr"):
        Metrics.model_validate(broken)


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"train_s": NaN}', '{"train_s": -Infinity}', "[" * 100_000])
def test_a_broken_document_is_named_with_a_remedy(tmp_path: Path, text: str) -> None:
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"metrics\.json.*Finish"):
        read_metrics(tmp_path / "metrics.json")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"iterations": "many"}, r"iterations: Input should be a valid integer"),
        ({"curve": [{"iteration": 1}]}, r"curve\[0\]\.train_s: Field required \(\d+ more"),
        ({"extra": 1}, r"extra: Extra inputs are not permitted"),
        ({"events": [{"iteration": 1, "kind": "exploded"}]}, r"events\[0\]: Input tag 'exploded'"),
    ],
)
def test_a_field_that_does_not_fit_is_named(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    (tmp_path / "metrics.json").write_text(json.dumps(values() | change))
    with pytest.raises(CheckpointError, match=rf"metrics\.json: {words}.*Finish"):
        read_metrics(tmp_path / "metrics.json")


def test_a_folder_without_a_record_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"holds no run.*run\.json"):
        read_record(tmp_path)


def test_the_hash_of_a_config_follows_its_values() -> None:
    draft = make_config("draft")
    assert config_hash(draft) == config_hash(make_config("draft"))
    assert config_hash(draft) != config_hash(make_config("draft", {"seed": 1}))


def test_facts_about_the_machine_are_strict_json(tmp_path: Path) -> None:
    write_document(tmp_path / "machine.json", machine_facts(3))
    assert read_document(tmp_path / "machine.json", MachineFacts, "").threads == 3
    assert version_facts().python.startswith("3.")
