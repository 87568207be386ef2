"""Captures on their way to the service: an archive, or a folder that is packed first."""

from __future__ import annotations

import os
import tempfile
import zipfile
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import httpx2

from client import calls
from client.answers import ClientError, RefusedError, RemoteJob
from client.retry_limit import TRANSIENT, RetryLimit

T = TypeVar("T")

CHUNK = 1 << 20
# Bytes of one request: a proxy may keep a body back until it is complete, and loses it when the connection breaks.
PART = 16 << 20
BROKEN_BODY = 400  # a proxy's or the service's answer to a connection that broke within a body
UPLOAD_TAKEN = 404  # the service's answer for a moment, while an earlier request of the same key makes the job

Observe = Callable[[int, int], None]
# A request, its body and a pause before it. The answer is sent back, or a `ClientError` thrown in.
Step = tuple[calls.Call[Any], Iterator[bytes] | None, float]
Steps = Generator[Step, Any, T]


@contextmanager
def packed(capture: Path | str) -> Iterator[Path]:
    """The archive of a capture; a folder is packed into a temporary file that is removed afterwards."""
    source = Path(capture)
    if os.path.isfile(source):  # False for a name too long to exist, where Path.is_file raises
        yield source
        return
    if not os.path.isdir(source):
        raise ClientError(f"{source}: there is no such file or folder.")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "capture.zip"
        # Images are compressed already, and a time before 1980, which zip cannot store, matters to nobody.
        with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED, strict_timestamps=False) as archive:
            for path in _files(source, frozenset()):
                archive.write(path, path.relative_to(source))
        yield target


def _files(folder: Path, above: frozenset[Path]) -> Iterator[Path]:
    """All files of a folder in order of their names, also of linked folders; `above` are those that it lies in."""
    real = folder.resolve()
    if real in above:
        raise ClientError(f"{folder}: is a link to a folder that it lies in. Remove it.")
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            yield from _files(path, above | {real})
        elif path.is_file():
            yield path


def chunks(archive: Path, observe: Observe | None, start: int, end: int) -> Iterator[bytes]:
    """The content from byte `start` to `end`. `observe` gets the number of bytes taken so far, and of all."""
    total = archive.stat().st_size
    with archive.open("rb") as file:
        file.seek(start)
        while chunk := file.read(min(CHUNK, end - file.tell())):
            yield chunk
            if observe is not None:
                observe(file.tell(), total)


def uploading(archive: Path, observe: Observe | None, how: calls.Query | None = None) -> Steps[str]:
    """The requests that bring an archive to the service, and at last the id of the upload.

    `how` is that of `calls.begin_upload`. After an interruption the service is asked how far it came, and the rest is
    sent, until nothing has arrived for `RETRY_FOR_S` after the first failure.
    """
    size = archive.stat().st_size
    state = yield calls.begin_upload(size, how), None, 0.0
    received, broken, limit = 0, False, RetryLimit(BROKEN_BODY)
    while broken or received < size:
        end, asked = min(size, received + PART), broken
        try:
            if asked:
                state = yield calls.upload_state(state["id"]), None, calls.RECONNECT_S
            else:
                part = calls.send_part(state["id"], received, end, size)
                state = yield part, chunks(archive, observe, received, end), 0.0
            broken = False
        except ClientError as error:
            limit.failed(error)
            broken = True
        if state["received"] > received:
            received = state["received"]
            limit.succeeded()
        elif asked:  # not after a part alone: most of it may have arrived
            limit.check()
    upload_id: str = state["id"]
    return upload_id


def requesting(call: calls.Call[RemoteJob], *also: int, reached: bool = False) -> Steps[RemoteJob]:
    """The request for a job, until it is answered; all have its key, so that they make one job.

    `also` are further statuses after which it is sent again. A service that was never `reached` is not waited for.
    """
    limit, pause = RetryLimit(*also), 0.0
    while True:
        try:
            job: RemoteJob = yield call, None, pause
        except ClientError as error:
            if not reached and isinstance(error.__cause__, httpx2.ConnectError):
                raise
            reached = True
            limit.failed(error)
            limit.check()
            pause = calls.RECONNECT_S
        else:
            return job


def submitting(
    archive: Path, observe: Observe | None, how: calls.Query, request: Callable[[str], calls.Call[RemoteJob]]
) -> Steps[RemoteJob]:
    """The requests that bring an archive to the service and make a job of it; `request` gets the id of the upload.

    Where the job is refused for good, the upload is deleted. After a minute without an answer it stays for its day: the
    service may still make a job of it.
    """
    upload_id = yield from uploading(archive, observe, how)
    try:
        return (yield from requesting(request(upload_id), UPLOAD_TAKEN, reached=True))
    except RefusedError as error:
        if error.status not in TRANSIENT | {UPLOAD_TAKEN}:
            with suppress(ClientError):  # the caller must hear of the refusal
                yield calls.delete_upload(upload_id), None, 0.0
        raise
