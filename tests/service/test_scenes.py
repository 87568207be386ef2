"""The player's routes: scene files written once for each checkpoint, cameras, and photographs beside the model."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

from graings.capture.images import ImageStore
from graings.capture.load import load_capture
from graings.evaluation.metrics import psnr
from graings.image_encoding import encode_image
from graings.player.scene_file import MEDIA_TYPE, read_scene
from graings.render import render
from graings.storage.checkpoint import load_model
from jobs.store import JobFolder
from service.comparison import GAIN
from tests.service.conftest import ITERATIONS, SIZE
from tests.service.test_render import pixels


def test_the_scene_is_that_of_the_newest_checkpoint(client: TestClient, model: str, trained: Path) -> None:
    answer = client.get(f"/jobs/{model}/scene")
    assert (answer.status_code, answer.headers["content-type"]) == (200, MEDIA_TYPE)
    _, header = read_scene(answer.content)
    loaded = load_model(trained)
    assert (header.digest, header.iteration) == (loaded.digest, ITERATIONS)
    assert answer.headers["x-graings-iteration"] == str(ITERATIONS)


def test_the_scene_file_is_written_once_for_a_checkpoint(client: TestClient, model: str, folder: JobFolder) -> None:
    first = client.get(f"/jobs/{model}/scene")
    (file,) = (folder.path / "scenes").iterdir()
    os.utime(file, (1, 1))
    assert client.get(f"/jobs/{model}/scene").headers["etag"] == first.headers["etag"]
    assert file.stat().st_mtime == 1
    shutil.copytree(newest(folder), newest(folder).parent / "00000099")
    (newest(folder) / "checkpoint.json").write_text(
        (newest(folder) / "checkpoint.json").read_text().replace(f'"iteration": {ITERATIONS}', '"iteration": 99')
    )
    after = client.get(f"/jobs/{model}/scene")
    assert after.status_code == 200
    assert len(list((folder.path / "scenes").iterdir())) == 1  # that of the earlier checkpoint is gone


def newest(folder: JobFolder) -> Path:
    return sorted(path for path in (folder.run / "checkpoints").iterdir() if path.name.isdigit())[-1]


def test_an_unchanged_scene_is_not_sent_again(client: TestClient, model: str) -> None:
    first = client.get(f"/jobs/{model}/scene")
    again = client.get(f"/jobs/{model}/scene", headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize(("checkpoint", "kept"), [(None, False), (ITERATIONS, True), (ITERATIONS - 1, False)])
def test_only_the_address_of_a_checkpoint_may_be_kept(
    client: TestClient, model: str, checkpoint: int | None, kept: bool
) -> None:
    query = {} if checkpoint is None else {"checkpoint": checkpoint}
    control = client.get(f"/jobs/{model}/scene", params=query).headers["cache-control"]
    assert ("immutable" in control, "no-cache" in control) == (kept, not kept)
    assert "private" in control


def test_a_part_of_the_scene_can_be_asked_for(client: TestClient, model: str) -> None:
    whole = client.get(f"/jobs/{model}/scene")
    part = client.get(f"/jobs/{model}/scene", headers={"Range": "bytes=100-199", "If-Range": whole.headers["etag"]})
    assert (part.status_code, part.content) == (206, whole.content[100:200])


def test_the_job_links_to_its_scene(client: TestClient, model: str) -> None:
    links = client.get(f"/jobs/{model}").json()["links"]
    assert links["scene"] == f"/jobs/{model}/scene?checkpoint={ITERATIONS}"
    assert {"views", "comparison"} <= set(links)


@pytest.mark.parametrize("what", ["scene", "views", "comparison"])
def test_a_job_without_a_checkpoint_has_none(client: TestClient, job: str, what: str) -> None:
    answer = client.get(f"/jobs/{job}/{what}")
    assert (answer.status_code, answer.json()["type"]) == (404, "urn:graings:problem:not-yet")
    assert what not in client.get(f"/jobs/{job}").json()["links"]


def test_the_cameras_are_those_of_the_scene_file(client: TestClient, model: str) -> None:
    _, header = read_scene(client.get(f"/jobs/{model}/scene").content)
    assert client.get(f"/jobs/{model}/views").json() == header.capture.to_json()


def test_a_photograph_beside_the_model_and_their_difference(
    client: TestClient, model: str, trained: Path, capture: Path, tmp_path: Path
) -> None:
    answer = client.get(f"/jobs/{model}/comparison", params={"camera": "val:0"})
    assert answer.status_code == 200
    shown = pixels(answer.content, tmp_path)
    assert shown.shape == (SIZE, 3 * SIZE, 3)
    loaded = load_model(trained)
    view, frame = loaded.views["val"][0], load_capture(capture, loaded.config.capture).val[0]
    photo = ImageStore(loaded.background).rgb(frame)
    drawn = render(loaded.scene, view.camera, view.time, loaded.background).color.clamp(0, 1).numpy()
    difference = np.clip(GAIN * np.abs(drawn - photo), 0, 1)
    for part, expected in enumerate((photo, drawn, difference)):
        found = shown[:, part * SIZE : (part + 1) * SIZE]
        np.testing.assert_array_equal(found, pixels(encode_image(expected, "png"), tmp_path))
    assert float(answer.headers["x-graings-psnr"]) == pytest.approx(psnr(drawn, photo), abs=0.006)


@pytest.mark.parametrize("camera", ["val:99", "sky:0", "val"])
def test_a_view_that_there_is_not_is_refused(client: TestClient, model: str, camera: str) -> None:
    answer = client.get(f"/jobs/{model}/comparison", params={"camera": camera})
    assert (answer.status_code, camera in answer.json()["detail"]) == (422, True)


def test_a_photograph_that_is_gone_is_named(client: TestClient, model: str, folder: JobFolder) -> None:
    context = client.app.state.context  # type: ignore[attr-defined]
    root = context.store.capture(folder.spec().capture)
    for image in (root / "val").iterdir():
        image.write_bytes(b"no image")
    answer = client.get(f"/jobs/{model}/comparison", params={"camera": "val:0"})
    assert answer.status_code == 422
    assert "val" in answer.json()["detail"]


def test_the_player_is_served_with_the_page(client: TestClient) -> None:
    for name, media in (("player.js", "javascript"), ("sort_worker.js", "javascript"), ("player.css", "css")):
        answer = client.get(f"/web/player/{name}")
        assert (answer.status_code, media in answer.headers["content-type"]) == (200, True)
        assert "default-src 'self'" in answer.headers["content-security-policy"]
