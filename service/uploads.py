"""Uploads: from a request body to an unpacked capture.

The body is hashed while it is written to disk, and unpacked beside it. After an error nothing remains.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import uuid
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from anyio import open_file, to_thread
from starlette.datastructures import FormData, UploadFile
from starlette.requests import Request

from graings.capture.synthetic import RECIPE_FILE, SceneRecipe
from graings.footage.source import video_suffix
from jobs.leftovers import discard_leftovers
from service.archives import Limits, unpack
from service.problems import BadRequest, UploadConflict

_CHUNK = 1 << 20

_BINARY = {"schema": {"type": "string", "format": "binary"}}
_FORM = {
    "type": "object",
    "required": ["capture"],
    "additionalProperties": False,
    "properties": {
        "capture": {
            "type": "string",
            "format": "binary",
            "description": "A zip, tar or tar.gz; or a video.",
        },
        "config": {"type": "string", "description": "Options as a JSON object, which override those of the query."},
    },
}
# How the routes that receive a capture describe their body.
CAPTURE_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "The capture, in one of the formats that are read from a folder, packed as zip, tar or tar.gz. "
        "Or a video, or an archive of photographs without poses: the job then finds their cameras first.",
        "content": {
            "video/*": _BINARY,
            "application/zip": _BINARY,
            "application/x-tar": _BINARY,
            "application/gzip": _BINARY,
            "multipart/form-data": {"schema": _FORM},
        },
    }
}


@dataclass(frozen=True, slots=True)
class Upload:
    """An unpacked capture: its folder, the SHA-256 of the archive, and the options from the form."""

    folder: Path
    digest: str
    config: dict[str, Any]


@asynccontextmanager
async def receive_capture(
    request: Request, uploads: Path, limits: Limits, received: Path | None = None
) -> AsyncIterator[Upload]:
    """The capture in the body of a request, which is an archive or a multipart form with one, or in `received`.

    `folder` is removed with the context unless it was moved. Raises `ArchiveError`, `BadRequest`, and `UploadConflict`
    where `received` is gone.
    """
    # Not only at the start of the service: files of a process that died may fill the disk that this upload needs.
    await to_thread.run_sync(discard_leftovers, uploads)
    name = uuid.uuid4().hex
    archive, folder, begun = uploads / f"{name}.part", uploads / name, uploads / f"{name}.begun"
    try:
        if received is not None:
            # The link has the time of the last byte that was received, which may be hours ago: without a younger file
            # beside it another request would take it for abandoned.
            await to_thread.run_sync(begun.touch)
            try:
                os.link(received, archive)
            except FileNotFoundError as error:
                raise UploadConflict("Another request just made a job of this upload. Send this one again.") from error
            config, digest = {}, await to_thread.run_sync(_digest, archive)
        elif request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
            async with request.form(max_files=1, max_fields=1) as form:
                config = _config_field(form)
                digest = await _store(_chunks(_capture_field(form)), archive)
        else:
            config, digest = {}, await _store(request.stream(), archive)
        suffix = await to_thread.run_sync(video_suffix, archive)
        if suffix is None:
            await to_thread.run_sync(unpack, archive, folder, limits)
            archive.unlink()
        else:
            folder.mkdir()
            archive.rename(folder / f"video{suffix}")
        yield Upload(folder, digest, config)
    finally:
        archive.unlink(missing_ok=True)
        begun.unlink(missing_ok=True)
        await to_thread.run_sync(lambda: shutil.rmtree(folder, ignore_errors=True))


@asynccontextmanager
async def scene_capture(scene: str, uploads: Path) -> AsyncIterator[Upload]:
    """The recipe of the synthetic scene of that name, as `receive_capture` gives what is sent."""
    recipe = json.dumps(SceneRecipe(scene=scene).to_json()).encode()
    folder = uploads / uuid.uuid4().hex
    try:
        folder.mkdir()
        (folder / RECIPE_FILE).write_bytes(recipe)
        yield Upload(folder, hashlib.sha256(recipe).hexdigest(), {})
    finally:
        await to_thread.run_sync(lambda: shutil.rmtree(folder, ignore_errors=True))


def parse_config(text: str, where: str) -> dict[str, Any]:
    """Parse a JSON object of options. Raises `BadRequest` naming the parameter `where`."""
    try:
        value = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise BadRequest(f"{where}: not JSON ({error}). Give an object of options, see /options.") from error
    if not isinstance(value, dict):
        raise BadRequest(f"{where}: must be a JSON object of options, see /options.")
    return value


async def _store(chunks: AsyncIterator[bytes], archive: Path) -> str:
    digest = hashlib.sha256()
    async with await open_file(archive, "xb") as file:
        async for chunk in chunks:
            digest.update(chunk)
            await file.write(chunk)
    return digest.hexdigest()


def _digest(archive: Path) -> str:
    with archive.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


async def _chunks(upload: UploadFile) -> AsyncIterator[bytes]:
    while chunk := await upload.read(_CHUNK):
        yield chunk


def _capture_field(form: FormData) -> UploadFile:
    value = form.get("capture")
    if not isinstance(value, UploadFile):
        raise BadRequest("capture: the form has no file of that name. Send the archive as the file field `capture`.")
    return value


def _config_field(form: FormData) -> dict[str, Any]:
    value = form.get("config", "{}")
    if not isinstance(value, str):
        raise BadRequest("config: must be a text field with a JSON object of options.")
    return parse_config(value, "config")


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a JSON number")
