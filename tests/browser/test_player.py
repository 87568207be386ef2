"""The player in a browser: what it draws is what `render` draws, and every way to control it works."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.typing import NDArray

from graings.evaluation.metrics import psnr
from graings.player.html import player_html
from graings.player.scene_file import read_scene, scene_bytes
from graings.render import PreparedScene, render, render_composition
from graings.storage.model import Model
from tests.browser.conftest import OpenPage
from tests.player.models import tiny_model

# Draws a camera of the page's scene at a time with modules of the page's own player.
DRAW = """
async ([index, time]) => {
  const facts = player.facts.cameras[index];
  const [width, height] = facts.size;
  const camera = cameraOf(viewpointOf(facts), width, height, width / height);
  const canvas = document.createElement("canvas");
  const renderer = new Renderer(canvas, player.renderer.scene);
  const order = await new Promise((resolve) => {
    new Sorter(player.renderer.scene, player.worker, resolve).sort(camera, time);
  });
  renderer.setOrder(order);
  renderer.draw(camera, time, player.facts.background);
  const picture = canvas.toDataURL("image/png");
  renderer.close();
  return picture;
}
"""


@pytest.fixture(scope="module")
def model() -> Model:
    return tiny_model(anchors=150)


@pytest.fixture(scope="module")
def page_file(model: Model, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with the scene, whose names tests can reach."""
    text = player_html(scene_bytes(model)).decode()
    end = "</script>\n</body>"
    assert text.count(end) == 1
    reachable = (
        "Object.assign(window, { player, Pictures, Renderer, Sorter, cameraOf, orbit, stateText, viewpointOf });\n"
    )
    path = tmp_path_factory.mktemp("page") / "scene.html"
    path.write_text(text.replace(end, reachable + end))
    return path


@pytest.fixture
def page(page_file: Path, open_page: OpenPage) -> Any:
    opened = open_page(page_file.as_uri(), viewport={"width": 500, "height": 500})
    opened.locator("#player[data-ready]").wait_for()
    return opened


def picture(data: bytes, folder: Path) -> NDArray[np.float32]:
    path = folder / "picture.png"
    path.write_bytes(data)
    return oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)[..., :3]


def shown(page: Any, folder: Path) -> NDArray[np.float32]:
    return picture(page.locator(".stage").screenshot(), folder)


def state(page: Any) -> str:
    return str(page.evaluate("player.state"))


def test_it_draws_what_the_rasterizer_draws(page: Any, model: Model, tmp_path: Path) -> None:
    scene, _ = read_scene(scene_bytes(model))
    prepared = PreparedScene(model.scene)
    for index in (0, 9, 25):
        view = (*model.views["train"], *model.views["val"])[index]
        for time in (0.0, 0.37, 1.0):
            drawn = picture(base64.b64decode(page.evaluate(DRAW, [index, time]).partition(",")[2]), tmp_path)
            same = render_composition(scene.compose(view.camera.center, time), view.camera, model.background)
            # The same Gaussians: half floats and the order of equal depths differ.
            assert psnr(drawn, same.color.clamp(0, 1)) > 46
            exact = render(prepared, view.camera, time, model.background)
            assert psnr(drawn, exact.color.clamp(0, 1)) > 34  # see tests/player/test_scene_file.py


def test_it_plays_and_stops(page: Any) -> None:
    clock = page.locator(".clock")
    page.get_by_role("button", name="Pause").wait_for()  # an exported page begins to play
    first = clock.text_content()
    page.wait_for_timeout(500)
    assert clock.text_content() != first
    page.get_by_role("button", name="Pause").click()
    stopped = clock.text_content()
    page.wait_for_timeout(300)
    assert clock.text_content() == stopped


def test_without_repeating_it_ends_at_the_last_time(page: Any) -> None:
    page.get_by_role("button", name="Repeat").click()
    page.get_by_label("Speed").select_option("4")
    page.get_by_role("button", name="Play", exact=True).wait_for()
    assert page.locator(".clock").text_content() == "1.000"


@pytest.fixture
def still(page: Any) -> Any:
    page.get_by_role("button", name="Pause").click()
    return page


def test_keys_change_view_and_time(still: Any) -> None:
    stage = still.locator(".stage")
    stage.focus()
    seen = {state(still)}
    for key in ("ArrowLeft", "ArrowUp", "Shift+ArrowRight", "+", "."):
        stage.press(key)
        assert state(still) not in seen, key
        seen.add(state(still))
    stage.press(" ")
    still.get_by_role("button", name="Pause").wait_for()


def test_hands_turn_move_and_zoom(still: Any) -> None:
    box = still.locator(".stage").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    start = state(still).split("view=")[1].split(",")
    still.mouse.move(x, y)
    still.mouse.down()
    still.mouse.move(x + 60, y + 20, steps=3)
    still.mouse.up()
    turned = state(still).split("view=")[1].split(",")
    assert (turned[:3], turned[7]) == (start[:3], start[7])  # target and distance
    assert turned[3:7] != start[3:7]
    still.keyboard.down("Shift")
    still.mouse.down()
    still.mouse.move(x, y, steps=3)
    still.mouse.up()
    still.keyboard.up("Shift")
    moved = state(still).split("view=")[1].split(",")
    assert moved[3:7] == turned[3:7]
    assert moved[:3] != turned[:3]
    still.mouse.wheel(0, -300)
    still.wait_for_timeout(100)
    assert float(state(still).split(",")[7]) < float(moved[7])
    still.mouse.dblclick(x, y)
    assert state(still).split("view=")[1].split(",") == start


def test_a_camera_of_the_capture_is_gone_to(still: Any, model: Model, tmp_path: Path) -> None:
    still.get_by_label("Camera").select_option("train:9")
    assert float(still.locator(".clock").text_content()) == pytest.approx(model.views["train"][9].time, abs=0.001)
    view = still.evaluate("player.view")
    np.testing.assert_allclose(
        np.array(view["rotation"]).reshape(3, 3), model.views["train"][9].camera.world_to_camera[:3, :3], atol=1e-6
    )


def test_the_background_can_be_chosen(still: Any, tmp_path: Path) -> None:
    still.get_by_label("Background", exact=True).select_option("#000000")
    still.wait_for_timeout(1000)
    np.testing.assert_allclose(shown(still, tmp_path)[20, 20], 0, atol=0.01)


def test_a_link_restores_view_and_time(still: Any, page_file: Path, open_page: OpenPage, tmp_path: Path) -> None:
    still.locator(".stage").press("ArrowLeft")
    still.get_by_role("slider", name="Time").fill("0.4")
    wanted = state(still)
    other = open_page(f"{page_file.as_uri()}#{wanted}", viewport={"width": 500, "height": 500})
    other.locator("#player[data-ready]").wait_for()
    assert state(other) == wanted
    for each in (still, other):
        each.wait_for_timeout(1500)
    pictures = [shown(each, tmp_path) for each in (still, other)]
    assert psnr(*pictures) > 40
    assert float(np.std(pictures[0])) > 0.02  # there is something in it


def test_a_link_opened_in_the_same_tab_restores_view_and_time(page: Any, page_file: Path) -> None:
    page.get_by_role("button", name="Pause").wait_for()  # it plays
    there = page.evaluate("stateText(0.4, orbit(player.view, player.facts.units.up, 1, 0.1))")
    page.goto(f"{page_file.as_uri()}#{there}")
    page.get_by_role("button", name="Play", exact=True).wait_for()
    assert page.evaluate("player.time") == 0.4
    restored = state(page)
    numbers = [[float(x) for x in text.split("view=")[1].split(",")] for text in (restored, there)]
    np.testing.assert_allclose(*numbers, atol=2e-5)  # each rounding is of 1e-5
    page.goto(f"{page_file.as_uri()}#")
    assert state(page) == restored


# Where a point of the scene, the target before, is drawn now.
DRAWN_AT = """
(point) => {
  const { rotation, center, fx, fy, cx, cy } = player.camera(1);
  const arm = point.map((value, i) => value - center[i]);
  const [x, y, z] = [0, 3, 6].map((row) => arm.reduce((sum, value, i) => sum + rotation[row + i] * value, 0));
  return [(fx * x) / z + cx, (fy * y) / z + cy];
}
"""


@pytest.mark.parametrize(("width", "height"), [(500, 500), (900, 400), (400, 700)])
def test_the_scene_follows_the_hand_in_a_window_of_any_shape(
    width: int, height: int, page_file: Path, open_page: OpenPage
) -> None:
    opened = open_page(page_file.as_uri(), viewport={"width": width, "height": height})
    opened.locator("#player[data-ready]").wait_for()
    opened.get_by_role("button", name="Pause").click()
    box = opened.locator(".stage").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    point = opened.evaluate("player.view.target")
    before = opened.evaluate(DRAWN_AT, point)
    opened.keyboard.down("Shift")
    opened.mouse.move(x, y)
    opened.mouse.down()
    opened.mouse.move(x + 60, y + 30, steps=3)
    opened.mouse.up()
    opened.keyboard.up("Shift")
    np.testing.assert_allclose(np.subtract(opened.evaluate(DRAWN_AT, point), before), (60, 30), atol=0.5)


# A request of a job that is under way when another job is chosen; it then succeeds or fails.
LATE = """
async (fails) => {
  let answer;
  const image = { src: "", decode: async () => {}, classList: player.image.classList };
  window.fetch = () => new Promise((resolve, reject) => {
    answer = () => (fails ? reject(new Error("too late")) : resolve({ ok: true, blob: async () => new Blob(["x"]) }));
  });
  player.pictures = new Pictures("/render?job=a", image, (error) => player.say(error ? error.message : ""));
  player.exact(1, 100);
  player.clear("another job");
  answer();
  await new Promise((resolve) => setTimeout(resolve, 100));
  return [image.src, image.classList.contains("shown"), player.message.textContent];
}
"""


@pytest.mark.parametrize("fails", [False, True])
def test_a_picture_that_comes_after_its_job_was_left_is_not_shown(still: Any, fails: bool) -> None:
    assert still.evaluate(LATE, fails) == ["", False, "another job"]


def test_every_control_has_a_name(page: Any) -> None:
    for control in page.locator("button, input, select, .stage").all():
        assert control.get_attribute("aria-label") or control.text_content(), control
    assert re.search("Arrows turn it", page.locator(".stage").get_attribute("aria-label"))
