"""Model: a trained scene with everything needed to render it, as JSON facts beside tensors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from torch import Tensor

from graings.camera.camera import Camera, View
from graings.camera.sampling_rate import SamplingRate
from graings.camera.units import Units
from graings.config import SceneConfig, TrainConfig, restored
from graings.scene.scaffold import Scaffold
from graings.scene.scene import Scene

# What Python, pydantic and torch raise where facts or tensors are not what they should be.
DAMAGE: Final = (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, RuntimeError)


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A trained scene with everything needed to render it: units, background and the capture's views."""

    scene: Scene
    units: Units
    background: tuple[float, float, float]
    views: Mapping[str, tuple[View, ...]]
    config: TrainConfig
    iteration: int
    finished: bool
    digest: str
    path: Path


def scene_bytes(scene: Scene) -> int:
    """Bytes of everything needed to render, in float32; uids count, because they break ties of depth."""
    return sum(t.numel() * t.element_size() for t in scene.state_dict().values())


def model_facts(
    *,
    scene: Scene,
    units: Units,
    background: Sequence[float],
    views: Mapping[str, Sequence[View]],
    config: TrainConfig,
    iteration: int,
    finished: bool,
) -> dict[str, Any]:
    """A model without its tensors, as a JSON document."""
    return {
        "iteration": iteration,
        "finished": finished,
        "temporal": scene.temporal,
        "sampling_rate": asdict(scene.sampling),
        "scene_config": scene.config.model_dump(mode="json"),
        "config": config.model_dump(mode="json"),
        "units": asdict(units),
        "background": list(background),
        "views": {split: [_view_to_json(view) for view in members] for split, members in views.items()},
    }


def model_from(facts: Mapping[str, Any], tensors: Mapping[str, Tensor], digest: str, path: Path) -> Model:
    """The model of `model_facts` and the tensors of its scene, as read from `path`.

    Raises `CheckpointError` for options that do not fit, and one of `DAMAGE` for damaged facts.
    """
    config = restored(TrainConfig, facts["config"], path)
    shape = restored(SceneConfig, facts["scene_config"], path)
    rows = {name: tensors[f"scaffold.{name}"] for name in Scaffold.ROWS}
    views = {split: tuple(map(_view_from_json, members)) for split, members in facts["views"].items()}
    rates = {name: float(value) for name, value in facts["sampling_rate"].items()}
    if not all(0.0 < value < math.inf for value in rates.values()):
        raise ValueError(f"sampling rates must be positive and finite, got {rates}")
    scene = Scene(
        shape,
        Scaffold(**rows),
        extent=float(tensors["extent"]),
        sampling=SamplingRate(**rates),
        initial_opacity=0.1,
    )
    scene.load_state_dict(tensors)
    scene.temporal = facts["temporal"]
    units = facts["units"]
    return Model(
        scene=scene,
        units=Units(
            tuple(units["center"]), units["scale"], units["time_start"], units["time_span"], tuple(units["up"])
        ),
        background=tuple(facts["background"]),
        views=views,
        config=config,
        iteration=facts["iteration"],
        finished=facts["finished"],
        digest=digest,
        path=path,
    )


def _view_to_json(view: View) -> dict[str, Any]:
    camera = view.camera
    return {
        "name": view.name,
        "time": view.time,
        "world_to_camera": camera.world_to_camera.tolist(),
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "size": [camera.width, camera.height],
    }


def _view_from_json(facts: dict[str, Any]) -> View:
    camera = Camera(np.array(facts["world_to_camera"]), *facts["intrinsics"], *facts["size"])
    return View(facts["name"], camera, facts["time"])
