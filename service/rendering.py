"""Rendering: loaded models, prepared for it, and a pool of threads that renders images of them.

Models are identified by path and modification time. Models and images are kept until they exceed a number of bytes;
the least recently used one is discarded first.
"""

from __future__ import annotations

import asyncio
import os
import sys
import threading
from collections import OrderedDict
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from graings.camera.camera import Camera
from graings.errors import CheckpointError
from graings.export.picture import Content, picture
from graings.image_encoding import ImageFormat
from graings.render import FastScene, PreparedScene
from graings.storage.compact import open_model
from graings.storage.model import Model, scene_bytes
from graings.storage.run_folder import newest_model

_Key = tuple[str, int]

# Priority of rendering threads below that of the others; trainings have a still lower one.
NICE = 5


@dataclass(frozen=True, slots=True)
class RenderRequest:
    """Everything an image depends on, except the model. `time` is in [0, 1], `background` is RGB in [0, 1].

    `fast` approximates the motion (`graings.render.FastScene`).
    """

    camera: Camera
    time: float
    background: tuple[float, float, float]
    format: ImageFormat
    content: Content = "color"
    fast: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class EncodedImage:
    """The bytes of an image, and the seconds that each step took; none for one that was kept."""

    data: bytes
    seconds: Mapping[str, float]


class LoadedModel:
    """A model in memory, prepared for rendering; for fast images when the first of them is asked for."""

    def __init__(self, model: Model, scene: PreparedScene) -> None:
        self.model, self.scene = model, scene
        self._fast: FastScene | None = None
        self._guard = threading.Lock()

    @property
    def bytes(self) -> int:
        """Memory that it takes."""
        fast = 0 if self._fast is None else self._fast.approximate.bytes
        return scene_bytes(self.model.scene) + self.scene.bytes + fast

    def fast(self) -> FastScene:
        """The scene of fast images. The first call takes seconds; may be called from several threads."""
        with self._guard:
            if self._fast is None:
                self._fast = FastScene.of(self.scene, self.model.views.get("train", ()))
            return self._fast


class ModelCache:
    """Models in memory, at most `max_bytes` of them or one. `load` may be called from several threads."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._loaded: OrderedDict[_Key, LoadedModel] = OrderedDict()
        self._guard = threading.Lock()

    def load(self, run: Path) -> LoadedModel | None:
        """The model of a run folder, from its newest readable checkpoint, or None. Raises `CheckpointError`."""
        # One at a time, so that two requests for the same new checkpoint read it once.
        with self._guard:
            newest = newest_model(run)
            if newest is None:
                return None
            key = _key(newest)
            loaded = self._loaded.get(key) if key else None
            if loaded is None:
                try:
                    model = open_model(run)
                except CheckpointError:
                    if newest_model(run) == newest:
                        raise
                    model = open_model(run)  # training removed this checkpoint while it was read
                if newest_model(run) != newest:
                    key = _key(model.path)
                loaded = LoadedModel(model, PreparedScene(model.scene))
                if key:
                    self._discard(newest.parent)
                    self._loaded[key] = loaded
            if key:
                self._loaded.move_to_end(key)
            while len(self._loaded) > 1 and self._bytes() > self._max_bytes:
                self._loaded.popitem(last=False)
            return loaded

    def _bytes(self) -> int:
        return sum(loaded.bytes for loaded in self._loaded.values())

    def _discard(self, folder: Path) -> None:
        """Discard the older models of the same run."""
        for key in [key for key in self._loaded if Path(key[0]).parent == folder]:
            del self._loaded[key]


class RenderPool:
    """Renders images on `slots` threads. An image that is being rendered is not started again for another request.

    The last images are kept, `kept_bytes` of them. Used on one event loop.
    """

    def __init__(self, slots: int, kept_bytes: int) -> None:
        self._executor = ThreadPoolExecutor(slots, thread_name_prefix="render", initializer=_lower_priority)
        self._kept_bytes = kept_bytes
        self._kept: OrderedDict[str, EncodedImage] = OrderedDict()
        self._running: dict[str, asyncio.Future[EncodedImage]] = {}

    @property
    def running(self) -> int:
        """Number of different images that are being rendered or wait for a thread."""
        return len(self._running)

    async def render(self, loaded: LoadedModel, request: RenderRequest, key: str) -> EncodedImage:
        """The encoded image; `key` identifies it with the model."""
        kept = self._kept.get(key)
        if kept is not None:
            self._kept.move_to_end(key)
            return kept
        running = self._running.get(key)
        if running is None:
            running = asyncio.get_running_loop().run_in_executor(
                self._executor, _rendered, loaded, request, perf_counter()
            )
            self._running[key] = running
            running.add_done_callback(lambda done: self._ended(key, done))
        return await asyncio.shield(running)  # a client that goes away does not end it for the others

    def close(self) -> None:
        """End the threads; images that are not started yet are not rendered."""
        self._executor.shutdown(cancel_futures=True)

    def _ended(self, key: str, done: asyncio.Future[EncodedImage]) -> None:
        del self._running[key]
        if done.cancelled() or done.exception() is not None:
            return  # reported by those who wait
        self._kept[key] = EncodedImage(done.result().data, {})
        size = sum(len(image.data) for image in self._kept.values())
        while size > self._kept_bytes:
            size -= len(self._kept.popitem(last=False)[1].data)


def _lower_priority() -> None:
    """Let threads that answer other requests run before this one, where a thread has a priority of its own (Linux)."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), min(19, os.getpriority(os.PRIO_PROCESS, 0) + NICE))


def _rendered(loaded: LoadedModel, request: RenderRequest, queued: float) -> EncodedImage:
    seconds = dict[str, float]()
    last = queued

    def note(part: str) -> None:
        nonlocal last
        now = perf_counter()
        seconds[part] = now - last
        last = now

    note("queue")
    scene = loaded.fast().seen_by(request.camera) if request.fast else loaded.scene
    view = (request.camera, request.time, request.background)
    data = picture(scene, *view, loaded.model.units, request.content, request.format, note=note)
    return EncodedImage(data, seconds)


def _key(path: Path) -> _Key | None:
    """The path with its modification time; None if it no longer exists."""
    try:
        return str(path), path.stat().st_mtime_ns
    except FileNotFoundError:
        return None
