"""A tiny model with views, as if trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from graings.camera.camera import Camera, View
from graings.camera.units import Units
from graings.config import make_config
from graings.storage.model import Model
from tests.models import tiny_scene

UNITS = Units((1.0, -2.0, 0.5), 0.25, time_start=3.0, time_span=2.0)


def tiny_model(**config: Any) -> Model:
    """Seen by a ring of 24 cameras and 3 held-out ones."""
    views = [
        View(f"v{i}", Camera.orbit(15.0 * i, 40.0 * ((i * 0.618) % 1), 2.5, fov=0.9, width=96, height=64), i / 23)
        for i in range(24)
    ]
    held = [View(f"h{i}", Camera.orbit(100.0 * i, 20.0, 2.5, fov=0.9, width=96, height=64), 0.5) for i in range(3)]
    return Model(
        scene=tiny_scene(**config),
        units=UNITS,
        background=(1.0, 1.0, 1.0),
        views={"train": tuple(views), "val": tuple(held)},
        config=make_config(),
        iteration=7,
        finished=True,
        digest="0" * 64,
        path=Path("tiny"),
    )
