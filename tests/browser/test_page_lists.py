"""The lists of jobs and tasks in the page of the service, and the form that adds a job."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import httpx2

from jobs.task_list import MAX_TASKS
from tests.browser.conftest import IdleService, OpenPage

FOCUSED = "document.activeElement.querySelector('.title')?.textContent"
REFRESH = "**/jobs?limit=20"


def press(page: Any, button: Any, request: str) -> None:
    """Press a button, and release it after the page has shown the answer of a request."""
    box = button.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    for _ in range(2):  # the first may have been on its way already
        with page.expect_response(request):
            pass
    page.wait_for_timeout(300)
    page.mouse.up()


def test_a_press_during_a_refresh_chooses_the_job(idle: IdleService, open_page: OpenPage) -> None:
    for name in ("older", "newer"):
        idle.submit(name)
    page = open_page(idle.url)
    page.locator("#name", has_text="newer").wait_for()
    press(page, page.locator("#jobs button", has_text="older"), REFRESH)
    page.locator("#name", has_text="older").wait_for(timeout=20_000)
    assert page.locator("#jobs button[aria-current=true] .title").all_text_contents() == ["older"]


def test_rows_change_in_place_and_keep_the_focus(idle: IdleService, open_page: OpenPage) -> None:
    older, between, _ = (idle.submit(name) for name in ("older", "between", "newer"))
    page = open_page(idle.url)
    page.locator("#name", has_text="newer").wait_for()
    page.locator("#jobs button", has_text="older").focus()
    idle.submit("newest")
    idle.context.jobs.cancel(older)
    page.locator("#jobs button", has_text="newest").wait_for()
    page.locator("#jobs .cancelled").wait_for()
    assert page.locator("#jobs .title").all_text_contents() == ["newest", "newer", "between", "older"]
    assert page.evaluate(FOCUSED) == "older"
    idle.context.jobs.delete(between)
    page.locator("#jobs button", has_text="between").wait_for(state="detached")
    assert page.locator("#jobs .title").all_text_contents() == ["newest", "newer", "older"]
    assert page.evaluate(FOCUSED) == "older"


def test_a_long_name_stays_within_the_list(idle: IdleService, open_page: OpenPage) -> None:
    idle.submit("a-name-" * 20)
    page = open_page(idle.url)
    page.locator("#jobs .title").wait_for()
    inner, outer = (page.locator(name).bounding_box() for name in ("#jobs button .state", "#jobs"))
    assert inner["x"] + inner["width"] <= outer["x"] + outer["width"]


def folder(capture: Path, tmp_path: Path, name: str) -> Path:
    return Path(shutil.copytree(capture, tmp_path / name))


def test_a_double_click_makes_one_job_and_the_preset_stays(
    idle: IdleService, capture: Path, open_page: OpenPage, tmp_path: Path
) -> None:
    page = open_page(idle.url)
    preset = page.get_by_label("Preset")
    page.locator("[name=preset] option:checked", has_text="standard").wait_for(state="attached")
    sent: list[str] = []
    page.on("request", lambda request: request.method == "POST" and sent.append(request.url))
    page.locator("#folder").set_input_files(folder(capture, tmp_path, "walking"))
    page.get_by_role("button", name="Train").dblclick()
    page.locator("#name", has_text="walking").wait_for()
    assert len(sent) == 1
    assert preset.input_value() == "standard"
    assert page.get_by_role("button", name="Train").is_disabled()  # no capture is chosen
    (job,) = httpx2.get(f"{idle.url}/jobs").json()["jobs"]
    assert httpx2.get(f"{idle.url}{job['links']['self']}").json()["config"]["preset"] == "standard"


def test_an_option_out_of_range_is_refused_with_its_name_also_in_a_closed_section(
    idle: IdleService, capture: Path, open_page: OpenPage, tmp_path: Path
) -> None:
    page = open_page(idle.url, may_fail="/jobs?preset=")
    page.locator("#settings > summary").click()
    page.get_by_label("iterations", exact=True).fill("-3")
    page.locator("#settings > summary").click()
    page.locator("#folder").set_input_files(folder(capture, tmp_path, "walking"))
    page.get_by_role("button", name="Train").click()
    page.locator("#refused", has_text="iterations").wait_for(timeout=20_000)


def test_spans_of_time_have_no_60_seconds_or_minutes(idle: IdleService, open_page: OpenPage) -> None:
    seconds = [0.4, 59.4, 59.6, 119.7, 3599.4, 3599.7, 7140, 7199]
    code = "seconds => import('/web/format.js').then(({ span }) => seconds.map(span))"
    shown = ["0 s", "59 s", "1 min 0 s", "2 min 0 s", "59 min 59 s", "1 h 0 min", "1 h 59 min", "2 h 0 min"]
    assert open_page(idle.url).evaluate(code, seconds) == shown


def test_a_capture_chosen_while_another_is_sent_is_kept(
    idle: IdleService, capture: Path, open_page: OpenPage, tmp_path: Path
) -> None:
    page = open_page(idle.url)
    page.locator("[name=preset] option:checked", has_text="standard").wait_for(state="attached")
    held: list[Any] = []

    def hold(route: Any) -> None:
        held.append(route)

    page.route(re.compile(r"/jobs\?preset="), hold)
    train = page.get_by_role("button", name="Train")
    page.locator("#folder").set_input_files(folder(capture, tmp_path, "first"))
    train.click()
    page.locator("#sending").wait_for()
    page.locator("#folder").set_input_files(folder(capture, tmp_path, "second"))
    page.locator("#chosen", has_text="second").wait_for()
    page.wait_for_timeout(300)
    assert train.is_disabled()
    page.get_by_label("Preset").select_option("draft")
    for name, preset in (("first", "standard"), ("second", "draft")):
        held.pop().continue_()
        page.locator("#name", has_text=name).wait_for()
        job = httpx2.get(f"{idle.url}/jobs").json()["jobs"][0]
        assert httpx2.get(f"{idle.url}{job['links']['self']}").json()["config"]["preset"] == preset
        if name == "first":
            assert page.locator("#chosen").text_content().startswith("second")
            train.click()
            page.wait_for_timeout(300)


def test_tasks_can_be_deleted_to_make_room(idle: IdleService, open_page: OpenPage) -> None:
    job = idle.submit("walker", model=True)
    for _ in range(MAX_TASKS):
        assert httpx2.post(f"{idle.url}/jobs/{job}/evaluate").status_code == 202
    page = open_page(f"{idle.url}/#job={job}", may_fail="/evaluate")
    lines = page.locator("#tasks li")
    lines.nth(MAX_TASKS - 1).wait_for()
    test_views = page.get_by_role("button", name="Test views")
    test_views.click()
    page.locator("#failure", has_text=f"{MAX_TASKS} tasks").wait_for(timeout=20_000)
    press(page, lines.first.get_by_role("button"), "**/tasks")
    lines.nth(MAX_TASKS - 1).wait_for(state="detached", timeout=20_000)
    assert page.locator("#failure").is_hidden()
    test_views.click()
    lines.nth(MAX_TASKS - 1).wait_for()
    assert page.locator("#failure").is_hidden()
    assert len(httpx2.get(f"{idle.url}/jobs/{job}/tasks").json()["tasks"]) == MAX_TASKS
