from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import OpenImageIO as oiio
import pytest
from starlette.testclient import TestClient

from graings.camera.camera import Camera
from graings.camera.view_request import MAX_SIDE
from graings.camera.viewpoint import orbit_view
from graings.image_encoding import encode_image
from graings.render import FastScene, PreparedScene, render
from graings.storage.checkpoint import load_model
from jobs.store import JobFolder
from service.rendering import LoadedModel, ModelCache, RenderPool, RenderRequest
from service.settings import Settings
from tests.service.conftest import ITERATIONS, SIZE
from tests.service.test_jobs import problem


def pixels(content: bytes, folder: Path, suffix: str = "png") -> Any:
    """The image [H, W, 3] in a response."""
    path = folder / f"image.{suffix}"
    path.write_bytes(content)
    return oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)


def test_a_view_of_the_capture_is_what_the_library_renders(client: TestClient, model: str, trained: Path) -> None:
    answer = client.get("/render", params={"t": 0.37, "camera": "val:1"})
    assert answer.status_code == 200
    loaded = load_model(trained)
    camera = loaded.views["val"][1].camera
    expected = render(loaded.scene, camera, 0.37, loaded.background)
    assert answer.content == encode_image(expected.color.numpy(), "png")
    assert answer.headers["x-graings-job"] == model
    assert answer.headers["x-graings-iteration"] == str(ITERATIONS)
    assert answer.headers["x-graings-finished"] == "true"


def test_a_fast_image_is_that_of_the_approximated_scene(client: TestClient, model: str, trained: Path) -> None:
    view = {"t": 0.37, "camera": "val:1"}
    exact, fast = (client.get("/render", params={**view, "fast": fast}) for fast in (False, True))
    loaded = load_model(trained)
    approximated = FastScene.of(PreparedScene(loaded.scene), loaded.views["train"])
    expected = render(approximated.approximate, loaded.views["val"][1].camera, 0.37, loaded.background)
    assert fast.content == encode_image(expected.color.numpy(), "png")
    assert fast.headers["x-graings-fast"] == approximated.report.line
    assert "x-graings-fast" not in exact.headers
    assert exact.content == client.get("/render", params=view).content
    assert exact.headers["etag"] != fast.headers["etag"]
    assert client.get("/render", params={**view, "fast": "quick"}).status_code == 422


def test_the_times_of_an_image_stand_in_its_answer(client: TestClient, model: str) -> None:
    """https://www.w3.org/TR/server-timing/, which browsers show beside the request."""
    first, again = (client.get("/render", params={"t": 0.123}).headers["server-timing"] for _ in range(2))
    steps = [part.split(";dur=") for part in first.split(", ")]
    assert [name for name, _ in steps] == ["request", "queue", "scene", "raster", "encode"]
    assert all(float(duration) >= 0 for _, duration in steps)
    assert again.startswith("request;dur=")
    assert "encode" not in again  # the image was kept


def test_an_orbit_takes_its_defaults_from_the_capture(client: TestClient, model: str, trained: Path) -> None:
    answer = client.get("/render", params={"azimuth": 40})
    loaded = load_model(trained)
    camera = orbit_view(loaded.views["train"], loaded.units, 40.0)
    expected = render(loaded.scene, camera, 0.0, loaded.background)
    assert answer.content == encode_image(expected.color.numpy(), "png")
    azimuth, elevation, radius = map(float, answer.headers["x-graings-orbit"].split())
    again = client.get("/render", params={"azimuth": azimuth, "elevation": elevation, "radius": radius})
    assert again.headers["x-graings-orbit"] == answer.headers["x-graings-orbit"]


def test_a_pose_in_the_captures_units_gives_the_same_image(client: TestClient, model: str, trained: Path) -> None:
    loaded = load_model(trained)
    camera = loaded.views["val"][0].camera
    pose = json.dumps(loaded.units.camera_back(camera).tolist())
    intrinsics = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "width": SIZE, "height": SIZE}
    posed = client.get("/render", params={"pose": pose, **intrinsics, "t": 0.5})
    assert posed.content == client.get("/render", params={"camera": "val:0", "t": 0.5}).content


def test_a_named_view_has_its_own_time(client: TestClient, model: str, trained: Path) -> None:
    time = load_model(trained).views["train"][5].time
    assert time == 1.0
    alone = client.get("/render", params={"camera": "train:5"})
    assert alone.headers["etag"] == client.get("/render", params={"camera": "train:5", "t": 1}).headers["etag"]
    assert alone.headers["etag"] != client.get("/render", params={"camera": "train:5", "t": 0}).headers["etag"]


@pytest.mark.parametrize(
    ("query", "size"),
    [({}, (24, 24)), ({"width": 48}, (48, 48)), ({"height": 12}, (12, 12)), ({"width": 30, "height": 10}, (30, 10))],
)
def test_one_length_keeps_the_aspect_ratio(
    client: TestClient, model: str, tmp_path: Path, query: dict[str, int], size: tuple[int, int]
) -> None:
    image = pixels(client.get("/render", params={"camera": "val:0", **query}).content, tmp_path)
    assert image.shape == (size[1], size[0], 3)


def test_the_background_is_the_requested_one(client: TestClient, model: str, tmp_path: Path) -> None:
    query = {"azimuth": 0, "elevation": 0, "radius": 1_000}  # so far away that only the background is visible
    for background, rgb in (("white", (1, 1, 1)), ("black", (0, 0, 0)), ("1,0,0.2", (1, 0, 0.2))):
        corner = pixels(client.get("/render", params={**query, "background": background}).content, tmp_path)[0, 0]
        np.testing.assert_allclose(corner, rgb, atol=0.5 / 255)


@pytest.mark.parametrize(
    ("accept", "format", "media", "start"),
    [
        ("*/*", None, "image/png", b"\x89PNG"),
        ("image/webp", None, "image/webp", b"RIFF"),
        ("image/png;q=0.5, image/jpeg;q=0.8", None, "image/jpeg", b"\xff\xd8"),
        ("image/png;q=0, image/*", None, "image/jpeg", b"\xff\xd8"),
        ("image/*;q=0.3, */*;q=0.9", None, "image/png", b"\x89PNG"),
        ("image/avif,image/webp,*/*;q=0.8", None, "image/webp", b"RIFF"),
        ("IMAGE/WEBP ; Q=1", None, "image/webp", b"RIFF"),
        ("image/png;q=x, image/jpeg;q=0.1", None, "image/jpeg", b"\xff\xd8"),
        ("", None, "image/png", b"\x89PNG"),
        ("image/x-exr", None, "image/x-exr", b"\x76\x2f\x31\x01"),
        ("text/html", "jpeg", "image/jpeg", b"\xff\xd8"),
    ],
)
def test_the_format_is_negotiated(
    client: TestClient, model: str, accept: str, format: str | None, media: str, start: bytes
) -> None:
    answer = client.get("/render", params={"format": format} if format else {}, headers={"Accept": accept})
    assert answer.headers["content-type"] == media
    assert answer.headers["vary"] == "Accept"
    assert answer.content.startswith(start)


def test_without_an_acceptable_format_the_request_fails_before_a_model_is_loaded(client: TestClient) -> None:
    for accept in ("text/html", "image/png;q=0", "image/png;q=nan"):
        assert "image/png" in problem(client.get("/render", headers={"Accept": accept}), 406)["detail"]


def test_an_unchanged_image_is_not_sent_again(client: TestClient, model: str) -> None:
    first = client.get("/render", params={"t": 0.25})
    etag = first.headers["etag"]
    assert etag.startswith('"')
    for known in (etag, f"W/{etag}", f'"other", {etag}', "*"):
        again = client.get("/render", params={"t": 0.25}, headers={"If-None-Match": known})
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", etag)
    for other in ({"t": 0.26}, {"t": 0.25, "azimuth": 1}, {"t": 0.25, "format": "webp"}, {"t": 0.25, "width": 25}):
        answer = client.get("/render", params=other, headers={"If-None-Match": etag})
        assert (answer.status_code, answer.headers["etag"] == etag) == (200, False)


@pytest.mark.parametrize(("asked", "drawn"), [("-3", "0"), ("1.5", "1")])
def test_a_time_outside_is_clamped_and_flagged(client: TestClient, model: str, asked: str, drawn: str) -> None:
    answer = client.get("/render", params={"t": asked})
    assert answer.headers["x-time-clamped"] == drawn
    inside = client.get("/render", params={"t": drawn})
    assert "x-time-clamped" not in inside.headers
    assert answer.content == inside.content


POSE = json.dumps(np.eye(4).tolist())


@pytest.mark.parametrize(
    ("query", "word"),
    [
        ({"t": "nan"}, "t"),
        ({"t": "inf"}, "t"),
        ({"t": "soon"}, "t"),
        ({"width": "0"}, "width"),
        ({"width": str(MAX_SIDE + 1)}, "width"),
        ({"elevation": "91"}, "elevation"),
        ({"fov": "180"}, "fov"),
        ({"radius": "0"}, "radius"),
        ({"radius": "1e400"}, "radius"),
        ({"target": "0,0"}, "target"),
        ({"target": "0,nan,0"}, "target"),
        ({"background": "mauve"}, "background"),
        ({"background": "2,0,0"}, "background"),
        ({"format": "gif"}, "format"),
        ({"camera": "val:99"}, "val:99"),
        ({"camera": "nowhere:0"}, "nowhere"),
        ({"camera": "val:0", "azimuth": "1"}, "one viewpoint"),
        ({"camera": "val:0", "fx": "1"}, "one viewpoint"),
        ({"pose": POSE}, "fx, width, height missing"),
        ({"fx": "9", "width": "9", "height": "9"}, "world_to_camera missing"),
        ({"pose": "[[1]]", "fx": "9", "width": "9", "height": "9"}, "shape"),
        ({"pose": "[[NaN", "fx": "9", "width": "9", "height": "9"}, "pose"),
        ({"pose": POSE.replace("1.0", "NaN"), "fx": "9", "width": "9", "height": "9"}, "finite"),
        ({"pose": POSE.replace("1.0", "2.0", 1), "fx": "9", "width": "9", "height": "9"}, "rigid"),
        ({"pose": POSE.replace("1.0", "1" + 400 * "0", 1), "fx": "9", "width": "9", "height": "9"}, "pose"),
        ({"pose": "[" * 3_900, "fx": "9", "width": "9", "height": "9"}, "pose"),
        ({"azimut": "30"}, "azimut"),
    ],
)
def test_an_invalid_parameter_is_named(client: TestClient, model: str, query: dict[str, str], word: str) -> None:
    assert word in problem(client.get("/render", params=query), 422)["detail"]


def test_a_side_that_the_aspect_ratio_makes_too_long_is_refused(
    client: TestClient, model: str, folder: JobFolder
) -> None:
    facts = folder.run / "checkpoints" / f"{ITERATIONS:08d}" / "checkpoint.json"
    document = json.loads(facts.read_text())
    document["views"]["val"][0]["size"] = [SIZE, 1]
    facts.write_text(json.dumps(document))
    wide = {"camera": "val:0", "height": 400}
    assert "9600x400" in problem(client.get("/render", params=wide), 422)["detail"]


def test_without_a_model_there_is_no_image_yet(client: TestClient, job: str) -> None:
    for query in ({}, {"job": job}):
        assert problem(client.get("/render", params=query), 404)["type"] == "urn:graings:problem:not-yet"
    problem(client.get("/render", params={"job": "0123456789abcdef"}), 404)


def test_the_newest_job_with_a_model_is_rendered(client: TestClient, model: str, archive: bytes) -> None:
    newer = client.post("/jobs", content=archive).json()["id"]
    assert newer > model
    assert client.get("/render").headers["x-graings-job"] == model


def test_a_damaged_checkpoint_hides_neither_the_one_before_nor_other_jobs(
    client: TestClient, model: str, folder: JobFolder, archive: bytes, trained: Path, settings: Settings
) -> None:
    newest = folder.run / "checkpoints" / f"{ITERATIONS:08d}"
    later = newest.with_name(f"{ITERATIONS + 5:08d}")
    shutil.copytree(newest, later)
    (later / "scene.safetensors").write_bytes(b"torn")
    answer = client.get("/render", params={"job": model})
    assert (answer.status_code, answer.headers["X-Graings-Iteration"]) == (200, str(ITERATIONS))
    other = client.post("/jobs", content=archive).json()["id"]
    shutil.copytree(later, settings.data / "jobs" / other / "run" / "checkpoints" / later.name)
    assert "damaged" in problem(client.get("/render", params={"job": other}), 500)["detail"]
    assert client.get("/render").headers["X-Graings-Job"] == model


def test_a_model_is_loaded_once_until_its_checkpoint_changes(trained: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    models = ModelCache(1)
    first = models.load(run)
    assert first is not None
    assert models.load(run) is first
    (run / "checkpoints" / f"{ITERATIONS:08d}").rename(run / "checkpoints" / f"{ITERATIONS + 1:08d}")
    second = models.load(run)
    assert second is not None
    assert second is not first
    other = shutil.copytree(trained, tmp_path / "other")
    assert models.load(Path(other)) is not None
    assert models.load(run) is not second  # discarded for the other one


def prepared(run: Path) -> LoadedModel:
    model = load_model(run)
    return LoadedModel(model, PreparedScene(model.scene))


def request_at(time: float) -> RenderRequest:
    camera = Camera.orbit(0.0, 0.0, 3.0, fov=0.7, width=8, height=8)
    return RenderRequest(camera, time, (1.0, 1.0, 1.0), "png")


def test_requests_for_one_image_share_its_rendering_and_get_equal_bytes(trained: Path) -> None:
    model, pool = prepared(trained), RenderPool(slots=2, kept_bytes=0)
    images: list[bytes] = []

    async def send(time: float) -> None:
        images.append((await pool.render(model, request_at(time), str(time))).data)

    async def all_at_once() -> None:
        async with anyio.create_task_group() as group:
            for time in (0.0, 0.5, 0.0, 0.0):
                group.start_soon(send, time)
            await anyio.sleep(0)
            assert pool.running == 2

    anyio.run(all_at_once)
    pool.close()
    assert len(images) == 4
    assert len({id(image) for image in images}) == 2


def test_the_last_images_are_kept_up_to_a_number_of_bytes(trained: Path) -> None:
    model = prepared(trained)

    async def images(kept_bytes: int, times: Sequence[float]) -> list[bytes]:
        pool = RenderPool(slots=1, kept_bytes=kept_bytes)
        rendered = [(await pool.render(model, request_at(time), str(time))).data for time in times]
        pool.close()
        return rendered

    first, _ = anyio.run(images, 0, (0.0, 1.0))
    again = anyio.run(images, 2 * len(first) + 20, (0.0, 1.0, 0.0, 0.5, 1.0, 0.0))
    assert again[0] is again[2]  # kept
    assert again[4] is not again[1]  # discarded for 0.5, since 0.0 was used later
    assert again[5] is not again[0]  # discarded for 1.0
    assert again[0] == again[5] == first
    none = anyio.run(images, len(first) - 1, (0.0, 0.0))
    assert none[0] is not none[1]


def test_an_image_that_cannot_be_rendered_is_tried_again(trained: Path) -> None:
    model, pool = prepared(trained), RenderPool(slots=1, kept_bytes=1_000)
    wrong = replace(request_at(0.0), background=(1.0, 1.0, math.nan))

    async def send(request: RenderRequest) -> bytes:
        return (await pool.render(model, request, "key")).data

    with pytest.raises(ValueError, match="finite"):
        anyio.run(send, wrong)
    assert anyio.run(send, request_at(0.0)).startswith(b"\x89PNG")
    pool.close()


def test_models_are_discarded_when_they_exceed_their_memory(trained: Path, tmp_path: Path) -> None:
    runs = [Path(shutil.copytree(trained, tmp_path / name)) for name in ("a", "b", "c")]
    models = ModelCache(2 * prepared(trained).bytes)
    first, second, _ = [models.load(run) for run in runs]
    assert models.load(runs[1]) is second
    assert models.load(runs[0]) is not first
    alone = ModelCache(1)
    assert alone.load(runs[0]) is alone.load(runs[0])  # one is kept however large it is
