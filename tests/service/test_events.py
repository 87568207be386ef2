from __future__ import annotations

import json
import threading
import time
from typing import Any

from starlette.testclient import TestClient

from graings.report.events import Grew
from jobs.progress import ProgressReport, ProgressWriter
from jobs.store import JobFolder

Event = tuple[str, str | None, Any]


def report(folder: JobFolder, *iterations: int) -> None:
    writer = ProgressWriter(folder.progress)
    for iteration in iterations:
        event = Grew(iteration=iteration, anchors=5)
        writer.write(ProgressReport(phase="joint", iteration=iteration, iterations=100, attempt=1, events=(event,)))
    writer.close()


def events(client: TestClient, job: str, last: str | None = None) -> list[Event]:
    """Name, id and data of all events of a stream that ends."""
    headers = {} if last is None else {"Last-Event-ID": last}
    answer = client.get(f"/jobs/{job}/events", headers=headers)
    assert answer.headers["content-type"].startswith("text/event-stream")
    found = []
    for block in answer.text.strip().split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if fields:
            found.append((fields["event"], fields.get("id"), json.loads(fields["data"])))
    return found


def iterations(found: list[Event]) -> list[int]:
    return [data["iteration"] for event, _, data in found if event == "progress"]


def test_a_stream_starts_with_the_newest_report_and_ends_with_the_job(
    client: TestClient, job: str, folder: JobFolder
) -> None:
    report(folder, 10, 20, 30)
    client.post(f"/jobs/{job}/cancel")
    found = events(client, job)
    assert iterations(found) == [30]
    assert [event for event, _, _ in found] == ["progress", "state", "end"]
    assert found[0][2]["events"] == [{"iteration": 30, "kind": "grew", "anchors": 5, "message": "grew 5 anchors"}]
    assert found[-1][2]["state"] == "cancelled"
    assert found[-1][2]["progress"]["iteration"] == 30


def test_a_stream_goes_on_after_the_last_event_that_was_seen(client: TestClient, job: str, folder: JobFolder) -> None:
    report(folder, 10, 20, 30)
    client.post(f"/jobs/{job}/cancel")
    whole = events(client, job, last="0")
    assert iterations(whole) == [10, 20, 30]
    for seen in range(3):
        assert iterations(events(client, job, last=whole[seen][1])) == [10, 20, 30][seen + 1 :]
    report(folder, 40)
    assert iterations(events(client, job, last=whole[2][1])) == [40]


def test_what_is_reported_while_one_listens_arrives(client: TestClient, job: str, folder: JobFolder) -> None:
    def later() -> None:
        time.sleep(0.7)
        report(folder, 50, 60)
        client.post(f"/jobs/{job}/cancel")

    thread = threading.Thread(target=later)
    thread.start()
    found = events(client, job)
    thread.join()
    assert iterations(found) == [50, 60]
    assert [data["state"] for event, _, data in found if event == "state"] == ["queued", "cancelled"]


def test_an_event_id_that_is_none_is_refused(client: TestClient, job: str) -> None:
    for wrong in ("-1", "x"):
        assert client.get(f"/jobs/{job}/events", headers={"Last-Event-ID": wrong}).status_code == 422
