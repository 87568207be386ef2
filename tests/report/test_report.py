from __future__ import annotations

import json
import math
import re
import stat
from pathlib import Path

import pytest

from graings.config import make_config
from graings.errors import CheckpointError
from graings.report.machine import machine_facts, version_facts
from graings.report.report import config_hash, read_metrics, write_metrics, write_text


def test_a_document_comes_back_as_it_went(tmp_path: Path) -> None:
    document = {"schema": "graings.metrics/1", "splits": {}, "train_s": 1.5, "curve": [{"psnr": None}]}
    write_metrics(tmp_path / "metrics.json", document)
    assert read_metrics(tmp_path / "metrics.json") == document


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_json_cannot_say_is_refused_by_its_key_and_leaves_the_file_alone(tmp_path: Path, value: float) -> None:
    file = tmp_path / "metrics.json"
    write_metrics(file, {"train_s": 1.0})
    with pytest.raises(ValueError, match=re.escape("splits.val.views[1].psnr")):
        write_metrics(file, {"splits": {"val": {"views": [{"psnr": 1.0}, {"psnr": value}]}}})
    assert read_metrics(file) == {"train_s": 1.0}
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]


def test_a_failed_write_leaves_no_scrap(tmp_path: Path) -> None:
    (tmp_path / "occupied").mkdir()
    with pytest.raises(OSError, match="occupied"):
        write_text(tmp_path / "occupied", "text")
    assert [path.name for path in tmp_path.iterdir()] == ["occupied"]


def test_others_may_read_a_report(tmp_path: Path) -> None:
    write_text(tmp_path / "curve.svg", "<svg/>")
    assert stat.S_IMODE((tmp_path / "curve.svg").stat().st_mode) == 0o644


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"train_s": NaN}', '{"train_s": -Infinity}'])
def test_a_broken_document_is_named_with_a_remedy(tmp_path: Path, text: str) -> None:
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"metrics\.json.*Finish"):
        read_metrics(tmp_path / "metrics.json")


def test_the_hash_of_a_config_follows_its_values() -> None:
    draft = make_config("draft")
    assert config_hash(draft) == config_hash(make_config("draft"))
    assert config_hash(draft) != config_hash(make_config("draft", {"seed": 1}))


def test_facts_about_the_machine_are_strict_json() -> None:
    facts = {**machine_facts(3), **version_facts()}
    assert json.loads(json.dumps(facts, allow_nan=False))["threads"] == 3
