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
    received = []
    for block in answer.text.strip().split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if fields:
            received.append((fields["event"], fields.get("id"), json.loads(fields["data"])))
    return received


def iterations(received: list[Event]) -> list[int]:
    return [data["iteration"] for event, _, data in received if event == "progress"]


def test_a_stream_starts_with_the_newest_report_and_ends_with_the_job(
    client: TestClient, job: str, folder: JobFolder
) -> None:
    report(folder, 10, 20, 30)
    client.post(f"/jobs/{job}/cancel")
    received = events(client, job)
    assert iterations(received) == [30]
    assert [event for event, _, _ in received] == ["progress", "state", "end"]
    assert received[0][2]["events"] == [{"iteration": 30, "kind": "grew", "anchors": 5, "message": "grew 5 anchors"}]
    assert received[-1][2]["state"] == "cancelled"
    assert received[-1][2]["progress"]["iteration"] == 30


def test_a_stream_continues_after_the_last_received_event(client: TestClient, job: str, folder: JobFolder) -> None:
    report(folder, 10, 20, 30)
    client.post(f"/jobs/{job}/cancel")
    whole = events(client, job, last="0")
    assert iterations(whole) == [10, 20, 30]
    for seen in range(3):
        assert iterations(events(client, job, last=whole[seen][1])) == [10, 20, 30][seen + 1 :]
    report(folder, 40)
    assert iterations(events(client, job, last=whole[2][1])) == [40]


def test_new_reports_arrive_in_an_open_stream(client: TestClient, job: str, folder: JobFolder) -> None:
    def later() -> None:
        time.sleep(0.7)
        report(folder, 50, 60)
        client.post(f"/jobs/{job}/cancel")

    thread = threading.Thread(target=later)
    thread.start()
    received = events(client, job)
    thread.join()
    assert iterations(received) == [50, 60]
    assert [data["state"] for event, _, data in received if event == "state"] == ["queued", "cancelled"]


def test_an_invalid_event_id_is_refused(client: TestClient, job: str) -> None:
    for wrong in ("-1", "x"):
        assert client.get(f"/jobs/{job}/events", headers={"Last-Event-ID": wrong}).status_code == 422
