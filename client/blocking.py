"""Client: the service for programs that wait for each answer."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import httpx2

from client import calls
from client.answers import ClientError, Event, RefusedError, RemoteJob
from client.captures import Observe, Steps, packed, requesting, submitting, uploading
from client.retry_limit import RetryLimit

T = TypeVar("T")


class Client:
    """A client of the service at `url`. Every method raises `RefusedError` if the service refuses.

    `key` is what `graings keys create` has shown; a service on this machine may need none. A `ClientError` says that
    the service does not answer.
    """

    def __init__(self, url: str = "http://127.0.0.1:8000", key: str | None = None, **options: Any) -> None:
        self._http = httpx2.Client(**calls.settings(url, key) | options)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    def submit(
        self,
        capture: Path | str,
        *,
        preset: str = "standard",
        config: calls.Query | None = None,
        name: str | None = None,
        priority: int = 10,
        webhook: str | None = None,
        observe: Observe | None = None,
    ) -> RemoteJob:
        """Train on a capture: a folder, or a zip, tar or tar.gz of one. `observe` gets the bytes sent and all.

        `webhook` is an address that is told what happens; `webhook_secret` in the document of the answer verifies its
        messages.
        """
        named, key, how = calls.job_name(name, capture), uuid.uuid4().hex, calls.training(preset, config)

        def request(upload_id: str) -> calls.Call[RemoteJob]:
            return calls.submit(upload_id, named, preset, config, priority, webhook, key)

        with packed(capture) as archive:
            return self._steps(submitting(archive, observe, how, request))

    def upload(self, capture: Path | str, observe: Observe | None = None) -> str:
        """Send a capture and return the id of its upload, of which a job can be made for a day.

        A connection that breaks, or a service that restarts, is continued where it broke.
        """
        with packed(capture) as archive:
            return self._steps(uploading(archive, observe))

    def submit_scene(self, scene: str, *, preset: str = "standard", config: calls.Query | None = None) -> RemoteJob:
        """Train on a synthetic scene, which the service draws itself: one of `scenes` in `GET /options`."""
        return self._steps(requesting(calls.submit_scene(scene, preset, config, uuid.uuid4().hex)))

    def job(self, job_id: str) -> RemoteJob:
        return self._do(calls.job(job_id))

    def jobs(self, **filters: Any) -> Iterator[RemoteJob]:
        """All jobs, newest first, without their options. `filters` are the parameters of `GET /jobs`."""
        path: str | None = f"/jobs?{httpx2.QueryParams(filters)}"
        while path is not None:
            jobs, path = self._do(calls.page(path))
            yield from jobs

    def events(self, job_id: str, after: str | None = None) -> Iterator[Event]:
        """What happens to a job, until it has ended; a broken connection is opened again where it broke."""
        limit = RetryLimit()
        while True:
            headers = {} if after is None else {"Last-Event-ID": after}
            try:
                with self._http.sse(f"/jobs/{job_id}/events", headers=headers) as stream:
                    if not stream.response.is_success:
                        stream.response.read()
                        calls.read(stream.response, lambda response: None)
                    empty = True
                    for event in stream:
                        limit.succeeded()
                        empty = False
                        after = event.id or after
                        yield Event(event.event, event.json())  # type: ignore[arg-type]
                        if event.event == "end":
                            return
                    if empty:
                        limit.failed(ClientError(calls.no_events(self._http.base_url)))
            except httpx2.TransportError as error:
                limit.failed(ClientError(calls.no_answer(self._http.base_url, error)))
            except RefusedError as error:
                limit.failed(error)
            limit.check()
            time.sleep(calls.RECONNECT_S)

    def wait(self, job_id: str, observe: Callable[[Event], None] | None = None) -> RemoteJob:
        """The job, when it has ended; `observe` gets every event meanwhile."""
        for event in self.events(job_id):
            if observe is not None:
                observe(event)
        return self.job(job_id)

    def render(self, job_id: str | None = None, path: Path | str | None = None, **view: Any) -> bytes:
        """An image of a job, or of the newest model; also written to `path`.

        `view` are the parameters of `GET /render`, such as t=0.3, azimuth=90, width=800, format="png"; `pose` may be a
        4x4 array and `target` three numbers.
        """
        content = self._do(calls.render(job_id, calls.with_format(view, path)))
        if path is not None:
            calls.save(content, path)
        return content

    def render_array(self, job_id: str | None = None, **view: Any) -> Any:
        """As `render`, as a uint8 array, height x width x 3. Needs numpy and Pillow."""
        return calls.image_array(self._do(calls.render(job_id, {**view, "format": "png"})))

    def download(self, job_id: str, result: str, path: Path | str) -> Path:
        """Write a result to a file: model, metrics, plan, report, log, curve.svg or report.svg."""
        return calls.save(self._do(calls.result(job_id, result)), path)

    def cancel(self, job_id: str) -> RemoteJob:
        return self._do(calls.change(job_id, "cancel"))

    def resume(self, job_id: str) -> RemoteJob:
        return self._do(calls.change(job_id, "resume"))

    def retry(self, job_id: str) -> RemoteJob:
        return self._do(calls.change(job_id, "retry"))

    def extend(self, job_id: str, iterations: int) -> RemoteJob:
        """Train a job that has succeeded for so many more iterations."""
        return self._do(calls.extend(job_id, iterations))

    def evaluate(self, job_id: str, split: str = "test") -> dict[str, Any]:
        """The metrics of a job that has ended, with those of the views of `split`; waits for them."""
        task = self._finished(self._do(calls.evaluate(job_id, split)))
        content: bytes = self._do(calls.linked(task, "metrics"))
        metrics: dict[str, Any] = json.loads(content)
        return metrics

    def video(self, job_id: str, path: Path | str, /, **options: Any) -> Path:
        """Have a video made and write it to `path`, whose suffix is its format; waits for it.

        `options` are the fields of the body of `POST /jobs/{id}/videos`, such as seconds=4, moves="time", width=400.
        """
        call, body = calls.make_video(job_id, path, options)
        task = self._finished(self._do(call, iter((body,))))
        return calls.save(self._do(calls.linked(task, "video")), path)

    def _finished(self, task: dict[str, Any]) -> dict[str, Any]:
        while not calls.finished(task):
            time.sleep(calls.POLL_S)
            task = self._do(calls.poll(task))
        return task

    def delete(self, job_id: str) -> None:
        self._do(calls.delete(job_id))

    def readiness(self) -> dict[str, Any]:
        return self._do(calls.readiness())

    def _steps(self, steps: Steps[T]) -> T:
        """Send the requests of `steps`, and return what it makes of their answers."""
        try:
            call, content, pause = next(steps)
            while True:
                time.sleep(pause)
                try:
                    answer = self._do(call, content)
                except ClientError as error:
                    call, content, pause = steps.throw(error)
                else:
                    call, content, pause = steps.send(answer)
        except StopIteration as end:
            result: T = end.value
            return result

    def _do(self, call: calls.Call[T], content: Iterator[bytes] | None = None) -> T:
        for attempt in range(calls.ATTEMPTS):
            try:
                response = self._http.request(
                    call.method, call.path, params=call.query or None, headers=call.headers, content=content
                )
            except httpx2.TransportError as error:
                raise ClientError(calls.no_answer(self._http.base_url, error)) from error
            pause = None if content is not None else calls.pause(response, attempt)
            if pause is None:
                return calls.read(response, call.read)
            time.sleep(pause)
        raise AssertionError("unreachable: the last attempt has no pause")
