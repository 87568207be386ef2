"""Shown: what `graings render` and `graings video` draw, a trained model or a file of splats."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import torch

from graings.camera.camera import Camera, View
from graings.camera.units import Units
from graings.camera.view_request import Color
from graings.export.formats import READABLE, read_splats, suffix_of
from graings.render import PreparedScene
from graings.scene.splats import Splats
from graings.storage.compact import open_model

UP: Final = (0.0, -1.0, 0.0)  # most files of splats have the axes of COLMAP

_SIZE, _FOV = 800, math.radians(50.0)
_DISTANCE = 1.3  # times that at which a sphere with nine tenths of the splats fills the picture


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """A scene in normalised units, and what `ViewRequest.resolve` needs. `digest` is the sha256 of its file."""

    scene: PreparedScene | Splats
    units: Units
    views: Mapping[str, tuple[View, ...]]
    background: Color
    digest: str


def open_shown(path: Path, up: Sequence[float] | None = None) -> Shown:
    """The model in a run, checkpoint or .graings file, or the splats in a file, whose vertical axis is `up` (or `UP`).

    Raises `CheckpointError`, and `ValueError` for an axis of length 0 or that of a model, which has its own.
    """
    if not path.is_file() or suffix_of(path, READABLE) is None:
        if up is not None:
            raise ValueError(f"up is for files of splats, and {path} is none: a model knows its vertical; leave it out")
        model = open_model(path)
        return Shown(PreparedScene(model.scene), model.units, model.views, model.background, model.digest)
    up = UP if up is None else up
    length = math.hypot(*up)
    if not (math.isfinite(length) and length > 0):
        raise ValueError(f"up must be three finite numbers, not all 0, got {tuple(up)}")
    splats, units = read_splats(path)
    units = replace(units, up=(up[0] / length, up[1] / length, up[2] / length))
    radius = float(torch.quantile(splats.means.double().norm(dim=1), 0.9))
    camera = Camera.orbit(
        *(0.0, 10.0, _DISTANCE * max(radius, 1e-3) / math.tan(_FOV / 2)),
        target=(0.0, 0.0, 0.0),
        up=units.up,
        fov=_FOV,
        width=_SIZE,
        height=_SIZE,
    )
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return Shown(splats, units, {"train": (View(path.name, camera, 0.0),)}, (1.0, 1.0, 1.0), digest)
