"""Calls: each request of the service, with how to read its answer. Both clients send them."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import httpx2

from client.answers import ClientError, RefusedError, RemoteJob

T = TypeVar("T")
Query = Mapping[str, Any]

TIMEOUT = httpx2.Timeout(120.0, connect=10.0)  # an image of a large scene, or the inspection of a large capture
RECONNECT_S = 1.0
POLL_S = 0.5
ATTEMPTS = 6
NAME_LENGTH = 120
RESULTS = ("model", "metrics", "plan", "report", "log", "curve.svg", "report.svg")


@dataclass(frozen=True, slots=True)
class Call(Generic[T]):
    """A request, and the function that reads its answer."""

    method: str
    path: str
    read: Callable[[httpx2.Response], T]
    query: Query = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)


def settings(url: str, key: str | None) -> dict[str, Any]:
    """How both clients connect."""
    headers = {} if key is None else {"Authorization": f"Bearer {key}"}
    return {"base_url": url, "headers": headers, "timeout": TIMEOUT}


def read(response: httpx2.Response, how: Callable[[httpx2.Response], T]) -> T:
    """The answer of the service. Raises `RefusedError`, and `ClientError` where another program answers."""
    if response.is_success:
        try:
            return how(response)
        except (ValueError, TypeError, LookupError) as error:  # such as a page that asks for a password
            raise ClientError(f"{response.url} answers, but not as this service does. Is its address right?") from error
    try:
        problem = response.json()
    except ValueError:  # from a proxy in between
        problem = {}
    raise RefusedError(response.status_code, problem if isinstance(problem, dict) else {})


def pause(response: httpx2.Response, attempt: int) -> float | None:
    """Seconds after which a busy service may be asked again; None if the answer counts."""
    wait = response.headers.get("retry-after", "")
    if response.status_code not in (429, 503) or not wait.isdigit() or attempt + 1 == ATTEMPTS:
        return None
    return float(wait)


def no_answer(url: httpx2.URL, error: Exception) -> str:
    """What to say when the service does not answer."""
    return f"{url} does not answer: {error or type(error).__name__}. Is the service running there?"


def no_events(url: httpx2.URL) -> str:
    """What to say when a stream of events ends before the first, which the service sends at once."""
    return f"{url} closes its streams of events at once. Is there a proxy in between that does not pass them on?"


def submit(
    upload_id: str, name: str, preset: str, config: Query | None, priority: int, webhook: str | None, key: str
) -> Call[RemoteJob]:
    query = {"capture": upload_id, "name": name, "priority": priority, **training(preset, config)}
    query |= {} if webhook is None else {"webhook": webhook}
    return Call("POST", "/jobs", _job, query, {"Idempotency-Key": key})


def job_name(name: str | None, capture: Path | str) -> str:
    """The name of a job: that of its capture unless another is given, as long as the service takes it."""
    path = Path(capture).resolve()
    title = path.name if os.path.isdir(path) else path.stem.removesuffix(".tar")  # of a path too long to exist, too
    return (name or title)[:NAME_LENGTH]


def begin_upload(size: int, how: Query | None = None) -> Call[dict[str, Any]]:
    """`how` it will be trained on is `training`: a wrong preset or option is refused before anything is sent."""
    return Call("POST", "/uploads", _json, {"bytes": size, **(how or {})})


def send_part(upload_id: str, start: int, end: int, size: int) -> Call[dict[str, Any]]:
    """The bytes from `start` to `end` of an archive."""
    length, part = str(end - start), f"bytes {start}-{end - 1}/{size}"
    headers = {"Content-Type": "application/octet-stream", "Content-Length": length, "Content-Range": part}
    return Call("PUT", f"/uploads/{upload_id}", _json, headers=headers)


def upload_state(upload_id: str) -> Call[dict[str, Any]]:
    return Call("GET", f"/uploads/{upload_id}", _json)


def delete_upload(upload_id: str) -> Call[None]:
    return Call("DELETE", f"/uploads/{upload_id}", lambda response: None)


def submit_scene(scene: str, preset: str, config: Query | None, key: str) -> Call[RemoteJob]:
    return Call("POST", "/jobs", _job, {"scene": scene, **training(preset, config)}, {"Idempotency-Key": key})


def training(preset: str, config: Query | None) -> Query:
    """The parameters that say how to train."""
    return {"preset": preset, "config": json.dumps(dict(config or {}))}


def job(job_id: str) -> Call[RemoteJob]:
    return Call("GET", f"/jobs/{job_id}", _job)


def change(job_id: str, verb: str) -> Call[RemoteJob]:
    return Call("POST", f"/jobs/{job_id}/{verb}", _job)


def extend(job_id: str, iterations: int) -> Call[RemoteJob]:
    return Call("POST", f"/jobs/{job_id}/extend", _job, {"iterations": iterations})


def evaluate(job_id: str, split: str) -> Call[dict[str, Any]]:
    return Call("POST", f"/jobs/{job_id}/evaluate", _json, {"split": split})


def make_video(job_id: str, path: Path | str, options: Query) -> tuple[Call[dict[str, Any]], bytes]:
    """The request for a video in the format that the file's name asks for, and its body."""
    body = json.dumps({"format": Path(path).suffix.lower().removeprefix("."), **options}).encode()
    headers = {"Content-Type": "application/json", "Content-Length": str(len(body))}
    return Call("POST", f"/jobs/{job_id}/videos", _json, headers=headers), body


def linked(task: dict[str, Any], name: str) -> Call[bytes]:
    """What a task links to."""
    return Call("GET", task["links"][name], _content)


def poll(task: dict[str, Any]) -> Call[dict[str, Any]]:
    """The same task now."""
    return Call("GET", task["links"]["self"], _json)


def finished(task: dict[str, Any]) -> bool:
    """Whether a task has succeeded. Raises `ClientError` if it ended otherwise."""
    if task["state"] in ("failed", "cancelled"):
        raise ClientError(task["error"] or "The task was cancelled.")
    return bool(task["state"] == "succeeded")


def delete(job_id: str) -> Call[None]:
    return Call("DELETE", f"/jobs/{job_id}", lambda response: None)


def page(path: str) -> Call[tuple[list[RemoteJob], str | None]]:
    """One page of the list: its jobs without their options, and the path of the next page."""
    return Call("GET", path, _page)


def render(job_id: str | None, query: Query) -> Call[bytes]:
    """The parameters of an image; lists become JSON for `pose` and numbers with commas for `target`."""
    given = {name: _text(name, value) for name, value in query.items() if value is not None}
    return Call("GET", "/render", _image, given if job_id is None else {"job": job_id, **given})


def with_format(view: Query, path: Path | str | None) -> Query:
    """The format that the name of a file asks for, unless `view` has one."""
    suffix = "" if path is None else Path(path).suffix.lower().removeprefix(".")
    return {"format": {"jpg": "jpeg"}.get(suffix, suffix) or None, **view}


def result(job_id: str, name: str) -> Call[bytes]:
    """A file of a job, one of `RESULTS`."""
    if name not in RESULTS:
        raise ClientError(f"There is no result {name!r}. Choose one of {', '.join(RESULTS)}.")
    return Call("GET", f"/jobs/{job_id}/{name}", _content)


def readiness() -> Call[dict[str, Any]]:
    return Call("GET", "/readyz", _json)


def image_array(content: bytes) -> Any:
    """The pixels of an image as a uint8 array, height x width x 3. Needs numpy and Pillow."""
    import numpy as np
    from PIL import Image

    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image.convert("RGB"))


def save(content: bytes, path: Path | str) -> Path:
    """Write a file, which appears only when it is complete."""
    target = Path(path)
    part = target.with_name(target.name + ".part")
    part.write_bytes(content)
    part.replace(target)
    return target


def _json(response: httpx2.Response) -> dict[str, Any]:
    value: dict[str, Any] = response.json()
    return value


def _job(response: httpx2.Response) -> RemoteJob:
    return RemoteJob.of(response.json())


def _page(response: httpx2.Response) -> tuple[list[RemoteJob], str | None]:
    body = response.json()
    return [RemoteJob.of(document) for document in body["jobs"]], body["next"]


def _content(response: httpx2.Response) -> bytes:
    return response.content


def _image(response: httpx2.Response) -> bytes:
    if not response.headers.get("content-type", "").startswith("image/"):
        raise ValueError("not an image")
    return response.content


def _text(name: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    if name == "target":
        return ",".join(str(float(number)) for number in value)
    if name == "pose":
        return json.dumps([[float(number) for number in row] for row in value])
    return str(value)
