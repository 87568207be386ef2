"""A tiny model with views, as if trained."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from graings.camera.camera import Camera, View
from graings.camera.units import Units
from graings.config import make_config
from graings.export.shown import Shown
from graings.render import PreparedScene
from graings.storage.model import Model
from tests.models import tiny_scene

UNITS = Units((1.0, -2.0, 0.5), 0.25, time_start=3.0, time_span=2.0)
SIZE = (40, 40)


def ring(count: int) -> list[Camera]:
    """Cameras around the origin, alternately above and below the equator."""
    return [
        Camera.orbit(
            360.0 * index / count,
            (-1) ** index * 60.0 * ((index * 0.618) % 1),
            2.0,
            target=(0.0, 0.0, 0.0),
            up=(0.0, 0.0, 1.0),
            fov=math.radians(50),
            width=SIZE[0],
            height=SIZE[1],
        )
        for index in range(count)
    ]


def tiny_model(**config: Any) -> Model:
    cameras = ring(24)
    return Model(
        scene=tiny_scene(**config),
        units=UNITS,
        background=(1.0, 1.0, 1.0),
        views={"train": tuple(View(f"v{i}", camera, i / 23) for i, camera in enumerate(cameras))},
        config=make_config(),
        iteration=1,
        finished=True,
        digest="0",
        path=Path("tiny"),
    )


def tiny_shown(digest: str = "0") -> Shown:
    """The tiny model, prepared."""
    model = tiny_model()
    return Shown(PreparedScene(model.scene), model.units, model.views, model.background, digest)
