"""Model: a trained scene with everything needed to render it, as JSON facts beside tensors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from torch import Tensor

from graings.camera.camera import Camera, View
from graings.camera.sampling_rate import SamplingRate
from graings.camera.units import Units
from graings.config import SceneConfig, TrainConfig, restored
from graings.constants import MAX_IMAGE_SIDE
from graings.scene.scaffold import Scaffold
from graings.scene.scene import Scene

# What Python, pydantic and torch raise where facts or tensors are not what they should be.
DAMAGE: Final = (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, RuntimeError)


Value = TypeVar("Value")


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
    extent = _finite([tensors["extent"].item()], 1, "extent")[0]
    if extent <= 0:
        raise ValueError(f"extent must be positive, got {extent}")
    scene = Scene(
        shape,
        Scaffold(**rows),
        extent=extent,
        sampling=SamplingRate(**rates),
        initial_opacity=0.1,
    )
    scene.load_state_dict(tensors)
    scene.temporal = _exactly(bool, facts["temporal"], "temporal")
    red, green, blue = _finite(facts["background"], 3, "background")
    return Model(
        scene=scene,
        units=_units_from_json(facts["units"]),
        background=(red, green, blue),
        views=views,
        config=config,
        iteration=_exactly(int, facts["iteration"], "iteration"),
        finished=_exactly(bool, facts["finished"], "finished"),
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
    width, height = (_exactly(int, side, "size") for side in facts["size"])
    if max(width, height) > MAX_IMAGE_SIDE:
        raise ValueError(f"size must be at most {MAX_IMAGE_SIDE} px, got {width}x{height}")
    fx, fy, cx, cy = _finite(facts["intrinsics"], 4, "intrinsics")
    camera = Camera(np.array(facts["world_to_camera"], np.float64), fx, fy, cx, cy, width, height)
    (time,) = _finite([facts["time"]], 1, "time")
    return View(_exactly(str, facts["name"], "name"), camera, time)


def _units_from_json(facts: dict[str, Any]) -> Units:
    x, y, z = _finite(facts["center"], 3, "center")
    up_x, up_y, up_z = _finite(facts["up"], 3, "up")
    scale, start, span = _finite([facts[name] for name in ("scale", "time_start", "time_span")], 3, "units")
    if scale <= 0:
        raise ValueError(f"scale must be positive, got {scale}")
    return Units((x, y, z), scale, start, span, (up_x, up_y, up_z))


def _exactly(kind: type[Value], value: object, name: str) -> Value:
    if type(value) is not kind:
        raise TypeError(f"{name} must be of type {kind.__name__}, got {type(value).__name__}")
    return value


def _finite(values: Sequence[object], count: int, name: str) -> list[float]:
    """The `count` numbers `values`. Raises `ValueError` for another length, and numbers that are not finite."""
    numbers = [float(value) for value in values if type(value) in (int, float)]  # type: ignore[arg-type]
    if len(values) != count or len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name} must be {count} finite numbers")
    return numbers
