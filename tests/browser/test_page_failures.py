"""The page of the service where a request is refused, and links that are opened in a page that is open already."""

from __future__ import annotations

import json
import re
from typing import Any

import httpx2
import pytest

from service.keys import Keys, Scope
from tests.browser.conftest import IdleService, OpenPage

# The next event of the job may replace a message at once.
RECORD_MESSAGES = """() => {
  const message = document.querySelector(".message");
  window.said = [];
  new MutationObserver(() => said.push(message.textContent)).observe(message, { childList: true });
}"""
GO_TO = "hash => { location.hash = hash; }"


def refreshed(page: Any) -> None:
    """Returns when the page has asked for the state of the service and for the jobs again."""
    for _ in range(2):
        with page.expect_response("**/jobs?limit=20"):
            pass
    page.wait_for_timeout(300)


@pytest.mark.parametrize("idle", [{"min_free_mb": 10**9}], indirect=True)
def test_jobs_are_listed_while_the_disk_is_nearly_full(idle: IdleService, open_page: OpenPage) -> None:
    idle.submit("to-be-deleted")
    page = open_page(idle.url, may_fail="/readyz")
    page.locator("#health", has_text="Delete jobs.").wait_for()
    page.locator("#jobs button", has_text="to-be-deleted").wait_for(timeout=20_000)
    refreshed(page)
    assert "Delete jobs." in page.locator("#health").text_content()


def test_an_error_of_an_action_stays_until_it_is_dismissed_or_the_next_action(
    idle: IdleService, open_page: OpenPage
) -> None:
    job = idle.submit("walker", model=True)
    page = open_page(f"{idle.url}/#job={job}", may_fail="/resume")
    page.locator("#name", has_text="walker").wait_for()
    resume = page.get_by_role("button", name="Resume")
    resume.wait_for()
    refuse = json.dumps({"detail": "The job is being deleted."})
    page.route("**/resume", lambda route: route.fulfill(status=409, content_type="application/json", body=refuse))
    failure = page.locator("#failure", has_text="The job is being deleted.")
    resume.click()
    failure.wait_for(timeout=20_000)
    refreshed(page)
    assert failure.is_visible()
    assert "No worker" in page.locator("#health").text_content()
    page.get_by_role("button", name="Dismiss").click()
    failure.wait_for(state="hidden")
    resume.click()
    failure.wait_for()
    page.unroute("**/resume")
    resume.click()
    page.locator("#jobs .queued").wait_for()
    assert page.locator("#failure").is_hidden()


BUSY = {"status": 503, "content_type": "application/json", "body": json.dumps({"detail": "It restarts."})}
PROXY = {"status": 502, "content_type": "text/html", "body": "<html>Bad gateway</html>"}  # not the service answers


@pytest.mark.parametrize(("answer", "message"), [(BUSY, "It restarts."), (PROXY, "The service answered 502.")])
@pytest.mark.parametrize("what", ["views", "scene"])
def test_what_could_not_be_fetched_once_is_fetched_again(
    idle: IdleService, open_page: OpenPage, what: str, answer: dict[str, Any], message: str
) -> None:
    page = open_page(idle.url, may_fail=f"/{what}")
    page.locator(".message", has_text="No model yet").wait_for()
    refused: list[str] = []

    def refuse(route: Any) -> None:
        refused.append(route.request.url)
        route.fulfill(**answer)

    page.evaluate(RECORD_MESSAGES)
    page.route(re.compile(f"/{what}"), refuse, times=1)
    idle.submit("walker", model=True)
    page.locator("#player[data-ready]").wait_for(timeout=60_000)
    assert len(refused) == 1
    assert page.locator(".message").text_content() == ""
    assert message in page.evaluate("said")


def test_a_stream_of_events_that_is_refused_is_opened_again(idle: IdleService, open_page: OpenPage) -> None:
    refused: list[str] = []
    page = open_page(idle.url, may_fail="/events")

    def refuse(route: Any) -> None:
        refused.append(route.request.url)
        route.fulfill(status=429, content_type="application/json", body=json.dumps({"detail": "Too many requests."}))

    page.route("**/events", refuse, times=1)
    with page.expect_response(lambda answer: answer.url.endswith("/events") and answer.ok, timeout=20_000):
        idle.submit("walker")
    assert len(refused) == 1


def shared(idle: IdleService, job: str) -> str:
    """What a link to the job adds to the address of the page."""
    answer = httpx2.post(f"{idle.url}/jobs/{job}/links").json()
    return str(answer["address"]).removeprefix("/")


def test_a_link_opened_in_a_page_that_is_open_shows_its_job(idle: IdleService, open_page: OpenPage) -> None:
    job = idle.submit("shared")
    idle.submit("private")
    page = open_page(idle.url)
    page.locator("#jobs button").nth(1).wait_for()
    page.evaluate(GO_TO, shared(idle, job))
    page.locator("body.guest").wait_for(state="attached", timeout=20_000)
    page.locator("#name", has_text="shared").wait_for()
    assert page.locator("#jobs button").count() == 1
    assert "link" not in page.evaluate("location.href")


def test_a_link_opened_in_a_page_that_is_open_shows_its_job_however_old_that_is(
    idle: IdleService, open_page: OpenPage
) -> None:
    old = idle.submit("old")
    for number in range(20):  # as many as the page lists at first
        idle.submit(f"new-{number}")
    page = open_page(idle.url)
    page.locator("#jobs button").nth(19).wait_for()
    page.evaluate(GO_TO, f"#job={old}")
    page.locator("#name", has_text="old").wait_for(timeout=20_000)


def test_a_link_opened_while_the_page_asks_for_a_key_shows_its_job(idle: IdleService, open_page: OpenPage) -> None:
    link = shared(idle, idle.submit("shared"))
    Keys(idle.context.store.root / "keys").create("ada", Scope.TRAIN)
    page = open_page(idle.url, may_fail="/session")
    page.get_by_label("Key").wait_for()
    page.evaluate(GO_TO, "#job=another")  # nothing to show it in
    page.evaluate(GO_TO, link)
    page.locator("body.guest").wait_for(state="attached", timeout=20_000)
    page.locator("#name", has_text="shared").wait_for()


def test_a_link_that_was_revoked_says_so_and_leaves_the_address(idle: IdleService, open_page: OpenPage) -> None:
    idle.submit("walker")
    page = open_page(idle.url, may_fail="/session")
    page.locator("#jobs button").wait_for()
    page.evaluate(GO_TO, "#link=revoked")
    page.locator("#failure", has_text="key").wait_for(timeout=20_000)
    assert "link" not in page.evaluate("location.href")
    assert page.locator("#jobs button").is_visible()
