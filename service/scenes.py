"""Scenes: loaded models and the pool that draws them.

Models are kept by what their file holds, the least recently used one leaves; images are drawn in a few threads,
and who finds too many waiting is turned away at once. Knows nothing of requests.
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
from graings.render import render
from graings.storage.compact import open_model
from graings.storage.model import Model
from graings.storage.run_folder import newest_model
from service.problems import Busy

_Key = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Picture:
    """Everything that decides what an image looks like, but for the model. `time` in [0, 1]."""

    camera: Camera
    time: float
    background: tuple[float, float, float]
    format: ImageFormat


class Scenes:
    """The models in memory, at most `models` of them. `load` may be called from several threads."""

    def __init__(self, models: int) -> None:
        self._models = models
        self._loaded: OrderedDict[_Key, Model] = OrderedDict()
        self._guard = threading.Lock()

    def load(self, run: Path) -> Model | None:
        """The model of a run folder, in its newest checkpoint that can be read, or None. Raises `CheckpointError`."""
        # One at a time: two requests for the same new checkpoint should read it once.
        with self._guard:
            newest = newest_model(run)
            if newest is None:
                return None
            key = _key(newest)
            model = self._loaded.get(key) if key else None
            if model is None:
                try:
                    model = open_model(run)
                except CheckpointError:
                    if newest_model(run) == newest:
                        raise
                    model = open_model(run)  # training went on and removed this one while it was read
                if newest_model(run) != newest:
                    key = _key(model.path)
                if key:
                    self._forget(newest.parent)
                    self._loaded[key] = model
            if key:
                self._loaded.move_to_end(key)
            while len(self._loaded) > self._models:
                self._loaded.popitem(last=False)
            return model

    def _forget(self, folder: Path) -> None:
        """Older models of the same run are not asked for again."""
        for key in [key for key in self._loaded if Path(key[0]).parent == folder]:
            del self._loaded[key]


class RenderPool:
    """Draws images, `slots` at a time; at most `waiting` more may wait."""

    def __init__(self, slots: int, waiting: int) -> None:
        self._limiter = CapacityLimiter(slots)
        self._most = slots + waiting
        self._inside = 0

    async def draw(self, model: Model, picture: Picture) -> bytes:
        """The encoded image. Raises `Busy`."""
        if self._inside >= self._most:
            raise Busy("Too many images are being rendered. Try again in a moment.")
        self._inside += 1
        try:
            return await to_thread.run_sync(self._draw, model, picture, limiter=self._limiter)
        finally:
            self._inside -= 1

    def _draw(self, model: Model, picture: Picture) -> bytes:
        result = render(model.scene, picture.camera, picture.time, picture.background)
        return encode_image(np.asarray(result.color, dtype=np.float32), picture.format)


def _key(path: Path) -> _Key | None:
    """What tells this file or folder from any other that is or was in its place; None when it is gone."""
    try:
        return str(path), path.stat().st_mtime_ns
    except FileNotFoundError:
        return None
