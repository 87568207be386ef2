"""NaN and infinity, in every place from which they could reach a JSON document."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from graings.report.metrics_document import Metrics
from jobs.progress import ProgressReport, ProgressWriter
from jobs.store import JobFolder

BAD = [float("nan"), float("inf"), -float("inf")]


def _refuse(constant: str) -> float:
    raise AssertionError(f"{constant} is not strict JSON")


def _floats(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths of all floats in a document."""
    if isinstance(value, float):
        yield path
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _floats(item, (*path, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _floats(item, (*path, index))


@pytest.mark.parametrize("bad", BAD)
def test_no_metric_can_be_stored_that_is_not_finite(trained: Path, bad: float) -> None:
    whole = json.loads((trained / "metrics.json").read_text())
    places = list(_floats(whole))
    assert len(places) > 20
    for *path, last in places:
        document = copy.deepcopy(whole)
        part = document
        for key in path:
            part = part[key]
        part[last] = bad
        with pytest.raises(ValueError, match=rf"(\.|\n){last}\n"):
            Metrics.model_validate(document)


@pytest.mark.parametrize("bad", BAD)
def test_a_report_that_is_not_finite_becomes_null_on_its_way_out(
    client: TestClient, job: str, folder: JobFolder, bad: float
) -> None:
    kinds = {name: str(field.annotation) for name, field in ProgressReport.model_fields.items()}
    numbers = [name for name, kind in kinds.items() if "float" in kind and "dict" not in kind]
    assert len(numbers) > 5
    writer = ProgressWriter(folder.progress)
    report = {"phase": "joint", "iteration": 1, "iterations": 9, "attempt": 1, **dict.fromkeys(numbers, bad)}
    writer.write(ProgressReport.model_validate(report))
    writer.close()
    answer = client.get(f"/jobs/{job}")
    assert answer.status_code == 200
    progress = json.loads(answer.text, parse_constant=_refuse)["progress"]
    assert [progress[name] for name in numbers] == [None] * len(numbers)
    listed = client.get("/jobs")
    assert listed.status_code == 200
    json.loads(listed.text, parse_constant=_refuse)
