from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import OpenImageIO as oiio
import pytest
from plyfile import PlyData
from starlette.testclient import TestClient

from service.routes import export
from tests.service.test_jobs import problem


def test_a_model_is_exported_as_splats(client: TestClient, model: str) -> None:
    answer = client.get(f"/jobs/{model}/export", params={"format": "ply", "t": 0.5, "degree": 1})
    assert answer.status_code == 200
    rows = PlyData.read(io.BytesIO(answer.content))["vertex"].data
    assert len(rows) == int(answer.headers["x-graings-splats"]) > 0
    assert sum(name.startswith("f_rest_") for name in rows.dtype.names) == 9
    assert answer.headers["content-disposition"] == f'attachment; filename="{model}.ply"'
    assert client.get(f"/jobs/{model}").json()["links"]["export"] == f"/jobs/{model}/export?format=ply"


@pytest.mark.parametrize(("format", "start"), [("spz", b""), ("glb", b"glTF"), ("sog", b"PK")])
def test_other_formats_are_exported(client: TestClient, model: str, format: str, start: bytes) -> None:
    answer = client.get(f"/jobs/{model}/export", params={"format": format})
    assert answer.status_code == 200
    assert answer.content.startswith(start)


def test_a_sequence_is_an_archive(client: TestClient, model: str) -> None:
    answer = client.get(f"/jobs/{model}/export", params={"format": "zip", "frames": 2})
    assert answer.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert len(json.loads(archive.read("manifest.json"))["frames"]) == 2


@pytest.mark.parametrize(
    ("parameters", "word"),
    [
        ({"format": "obj"}, "compressed.ply"),
        ({"format": "ply", "t": "2"}, "t"),
        ({"format": "ply", "box": "1,2,3"}, "six numbers"),
        ({"format": "ply", "sphere": "1,2,3,x"}, "float"),
        ({"format": "ply", "sphere": "1,2,3,nan"}, "finite"),
        ({"format": "ply", "sphere": "900,0,0,1"}, "widen"),
        ({"format": "zip", "frames": "100000"}, "frames"),
        ({"format": "zip", "frames": "2", "t": "0.5"}, "time is not used"),
        ({"format": "ply", "frames": "2"}, "frames is not used"),
        ({"format": "splat", "degree": "1"}, "degree"),
    ],
)
def test_a_wrong_parameter_is_named(client: TestClient, model: str, parameters: dict[str, str], word: str) -> None:
    answer = client.get(f"/jobs/{model}/export", params=parameters)
    assert answer.status_code == 422
    assert word in json.dumps(answer.json())


def test_a_job_without_a_model_has_no_export_yet(client: TestClient, job: str) -> None:
    assert problem(client.get(f"/jobs/{job}/export", params={"format": "ply"}), 404)["type"].endswith("not-yet")


def test_one_export_is_made_at_a_time(client: TestClient, model: str) -> None:
    with export._ONE:
        answer = client.get(f"/jobs/{model}/export", params={"format": "ply"})
    assert problem(answer, 503)["type"].endswith("busy")
    assert answer.headers["retry-after"]
    assert client.get(f"/jobs/{model}/export", params={"format": "ply"}).status_code == 200


@pytest.mark.parametrize(
    ("show", "format", "channels"),
    [("rgba", "png", "RGBA"), ("alpha", "png", "Y"), ("depth", "exr", "Z"), ("layers", "exr", "RGBAZ")],
)
def test_a_view_shows_transparency_and_depth(
    client: TestClient, model: str, show: str, format: str, channels: str, tmp_path: Path
) -> None:
    answer: Any = client.get("/render", params={"show": show, "format": format, "t": 0.4})
    assert answer.status_code == 200
    (tmp_path / f"a.{format}").write_bytes(answer.content)
    assert "".join(oiio.ImageInput.open(str(tmp_path / f"a.{format}")).spec().channelnames) == channels
    assert answer.headers["etag"] != client.get("/render", params={"format": format, "t": 0.4}).headers["etag"]


def test_layers_need_exr(client: TestClient, model: str) -> None:
    assert "exr" in problem(client.get("/render", params={"show": "layers", "format": "png"}), 422)["detail"]


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ({"format": "foo", "t": 0.3}, "format 'foo' is not written"),
        ({"format": "zip", "t": 0.3}, "a time is not used by a .zip file"),
        ({"format": "ply", "frames": 3}, "a number of frames is not used by a .ply file"),
    ],
)
def test_an_export_that_cannot_be_made_is_refused_for_its_own_reason(
    client: TestClient, model: str, query: dict[str, Any], message: str
) -> None:
    assert message in problem(client.get(f"/jobs/{model}/export", params=query), 422)["detail"]
