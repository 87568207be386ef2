"""Rendering: loaded models, prepared for it, and a pool of threads that renders images of them.

Models are identified by path and modification time; the least recently used one is discarded. If too many requests wait
for a thread, further ones are refused at once.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from anyio import CapacityLimiter, to_thread

from graings.camera.camera import Camera
from graings.errors import CheckpointError
from graings.image_encoding import ImageFormat, encode_image
from graings.render import PreparedScene, render
from graings.storage.compact import open_model
from graings.storage.model import Model
from graings.storage.run_folder import newest_model
from service.problems import Busy

_Key = tuple[str, int]


@dataclass(frozen=True, slots=True)
class RenderRequest:
    """Everything an image depends on, except the model. `time` is in [0, 1], `background` is RGB in [0, 1]."""

    camera: Camera
    time: float
    background: tuple[float, float, float]
    format: ImageFormat


@dataclass(frozen=True, slots=True, eq=False)
class LoadedModel:
    """A model in memory, prepared for rendering."""

    model: Model
    scene: PreparedScene


class ModelCache:
    """At most `capacity` models in memory. `load` may be called from several threads."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
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
            while len(self._loaded) > self._capacity:
                self._loaded.popitem(last=False)
            return loaded

    def _discard(self, folder: Path) -> None:
        """Discard the older models of the same run."""
        for key in [key for key in self._loaded if Path(key[0]).parent == folder]:
            del self._loaded[key]


class RenderPool:
    """Renders images, `slots` at a time; at most `waiting` further requests may wait."""

    def __init__(self, slots: int, waiting: int) -> None:
        self._limiter = CapacityLimiter(slots)
        self._max_requests = slots + waiting
        self._requests = 0

    async def render(self, loaded: LoadedModel, request: RenderRequest) -> bytes:
        """The encoded image. Raises `Busy`."""
        if self._requests >= self._max_requests:
            raise Busy("Too many images are being rendered. Try again in a moment.")
        self._requests += 1
        try:
            return await to_thread.run_sync(_rendered, loaded, request, limiter=self._limiter)
        finally:
            self._requests -= 1


def _rendered(loaded: LoadedModel, request: RenderRequest) -> bytes:
    result = render(loaded.scene, request.camera, request.time, request.background)
    return encode_image(np.asarray(result.color, dtype=np.float32), request.format)


def _key(path: Path) -> _Key | None:
    """The path with its modification time; None if it no longer exists."""
    try:
        return str(path), path.stat().st_mtime_ns
    except FileNotFoundError:
        return None
