"""Captures over HTTP: what is in one, and the same reasons as on the command line for what is refused."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

from graings.capture.load import load_capture
from graings.errors import CaptureError
from graings.inspection.document import Inspection
from graings.inspection.inspect import inspect_capture
from service.settings import Settings
from tests.capture.captures import write_dnerf, write_single

ZIP = {"Content-Type": "application/zip"}


def packed(folder: Path, prefix: str = "") -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.writestr(prefix + path.relative_to(folder).as_posix(), path.read_bytes())
    return data.getvalue()


def test_an_inspection_is_that_of_the_command_line_and_leaves_nothing(
    client: TestClient, tmp_path: Path, settings: Settings
) -> None:
    folder = write_single(tmp_path, 10)
    answer = client.post("/captures", content=packed(folder, "scan/"), headers=ZIP)
    assert answer.status_code == 200, answer.text
    found = Inspection.model_validate(answer.json())
    expected, _ = inspect_capture(folder)
    assert found.content_hash == expected.content_hash
    assert found.findings == expected.findings
    assert found.images == {"train": 7, "val": 1, "test": 2}
    assert client.get("/jobs").json()["jobs"] == []
    assert [*(settings.data / "uploads").iterdir(), *(settings.data / "captures").iterdir()] == []


def test_options_change_how_a_capture_is_read(client: TestClient, tmp_path: Path) -> None:
    options = {"config": json.dumps({"capture.times_from_names": True, "capture.max_side": 32})}
    answer = client.post("/captures", params=options, content=packed(write_single(tmp_path, 10)), headers=ZIP)
    assert answer.json()["statistics"]["times"] == 7
    assert answer.json()["statistics"]["width"] == 32


def heic(folder: Path) -> None:
    (folder / "train/r_002.png").unlink()
    (folder / "train/r_002.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(64))


def metashape(folder: Path) -> None:
    for path in folder.glob("*.json"):
        path.unlink()
    (folder / "cameras.xml").write_text("<document/>")


def scaled(folder: Path) -> None:
    path = folder / "transforms_train.json"
    document = json.loads(path.read_text())
    pose = np.array(document["frames"][2]["transform_matrix"])
    pose[:3, 0] *= -2
    document["frames"][2]["transform_matrix"] = pose.tolist()
    path.write_text(json.dumps(document), encoding="utf-16")


@pytest.mark.parametrize("breaks", [heic, metashape, scaled])
@pytest.mark.parametrize("route", ["/captures", "/jobs"])
def test_a_capture_is_refused_with_the_reason_of_the_command_line(
    client: TestClient, tmp_path: Path, breaks: object, route: str
) -> None:
    (tmp_path / "scene").mkdir()
    folder = write_dnerf(tmp_path / "scene", [0.0, 0.3, 0.6, 1.0])
    breaks(folder)  # type: ignore[operator]
    with pytest.raises(CaptureError) as caught:
        load_capture(folder)
    answer = client.post(route, content=packed(folder), headers=ZIP)
    assert answer.status_code == 422, answer.text
    assert caught.value.problem in answer.json()["detail"]
    assert caught.value.remedy in answer.json()["detail"]
